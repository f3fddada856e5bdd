"""`kinematics` in the process of a test, which may break parts of it."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import rclpy
from rclpy.executors import SingleThreadedExecutor

from longarm_comp.nodes.kinematics import Kinematics


@contextmanager
def kinematics_inside(**parameters: object) -> Iterator[Kinematics]:
    """Spin the node in a thread of this process, with these parameters."""
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    with ExitStack() as ends:
        rclpy.init(args=["--ros-args", *words])
        ends.callback(rclpy.try_shutdown)
        executor = SingleThreadedExecutor()
        node = Kinematics(executor)
        ends.callback(node.destroy_node)
        ends.callback(executor.shutdown, timeout_sec=1.0)
        ends.callback(node.close)
        executor.add_node(node)
        over = threading.Event()

        def spin() -> None:
            while not over.is_set():
                executor.spin_once(timeout_sec=0.1)

        thread = threading.Thread(target=spin)
        thread.start()
        ends.callback(thread.join)
        ends.callback(over.set)
        yield node
