"""Frames on /tf: publishes a node's own frames, and listens to the frames of others.

Without tf2_msgs nothing is published, and nothing is heard of other frames. Names of an arm's
frames begin with its namespace: ``left_arm/base``.
"""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Transform, TransformStamped
from rclpy.node import Node
from std_msgs.msg import Header

from longarm_comp.core.arm.frame_tree import FrameTree, NotYet
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.link_frames import Placed
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_ns
from longarm_comp.nodes.messages import quaternion_message, vector_message


def prefix_of(node: Node) -> str:
    """Return the prefix of a node's frame names, such as ``left_arm/``; "" without a namespace."""
    namespace = node.get_namespace().strip("/")
    return f"{namespace}/" if namespace else ""


class FrameTeller:
    """Publishes frames of a node under their full names."""

    def __init__(self, node: Node) -> None:
        self._moving = graph.TF.publisher(node) if graph.HAS_TF else None
        self._standing = graph.TF_STATIC.publisher(node) if graph.HAS_TF else None
        self._clock = node.get_clock()

    def tell(self, frames: Sequence[Placed], stamp: Time) -> None:
        if self._moving is not None:
            self._moving.publish(self._make_message(frames, stamp))

    def tell_static(self, frames: Sequence[Placed]) -> None:
        """Publish fixed frames. They replace the fixed frames published before."""
        if self._standing is not None:
            self._standing.publish(self._make_message(frames, self._clock.now().to_msg()))

    @property
    def listeners(self) -> int:
        """Number of subscriptions to /tf, including those of this process."""
        return 0 if self._moving is None else self._moving.get_subscription_count()

    def _make_message(self, frames: Sequence[Placed], stamp: Time) -> Any:
        return graph.TF.type(
            transforms=[
                TransformStamped(
                    header=Header(stamp=stamp, frame_id=frame.parent),
                    child_frame_id=frame.name,
                    transform=Transform(
                        translation=vector_message(frame.position),
                        rotation=quaternion_message(frame.turn),
                    ),
                )
                for frame in frames
            ]
        )


class FrameListener:
    """Keeps the frames published on /tf and /tf_static. They may be read from any thread.

    ``wait_s``: longest wait for a frame that is published late, s. ``refused`` is called for every
    invalid transform.
    """

    def __init__(self, node: Node, wait_s: float, refused: Callable[[str, str], None]) -> None:
        self._tree, self._told = FrameTree(), threading.Condition()
        self._wait_s, self._refused = wait_s, refused
        if graph.HAS_TF:
            graph.TF.subscription(node, lambda message: self._hear_tf(message, static=False))
            graph.TF_STATIC.subscription(node, lambda message: self._hear_tf(message, static=True))

    def place(self, frame: str, within: str, t_ns: int) -> np.ndarray:
        """Return the pose (4, 4), m, of a frame in the frame ``within`` at ``t_ns``; 0: the latest.

        Raises:
            UnknownPlace: the pose is not known.
        """
        end = time.monotonic() + self._wait_s
        with self._told:
            while True:
                try:
                    return self._tree.place(frame, within, t_ns)
                except NotYet:
                    if not self._told.wait(end - time.monotonic()):
                        raise

    def hangs_on(self, frame: str, other: str) -> bool:
        """Tell whether `other` is the frame itself or one of its parents in the tf tree."""
        with self._told:
            return self._tree.hangs_on(frame, other)

    def know(self, frames: Sequence[Placed]) -> None:
        """Add fixed frames, as if they had been published on /tf_static."""
        with self._told:
            for each in frames:
                self._tree.hear(each.parent, each.name, each.position, each.turn, 0, static=True)
            self._told.notify_all()

    def _hear_tf(self, message: Any, *, static: bool) -> None:
        with self._told:
            for said in message.transforms:
                p, o = said.transform.translation, said.transform.rotation
                try:
                    self._tree.hear(
                        said.header.frame_id.lstrip("/"),
                        said.child_frame_id.lstrip("/"),
                        np.array([p.x, p.y, p.z]),
                        np.array([o.x, o.y, o.z, o.w]),
                        stamp_ns(said.header.stamp),
                        static=static,
                    )
                except InputError as error:
                    self._refused("bad tf", str(error))
            self._told.notify_all()
