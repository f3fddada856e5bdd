"""The driver's side of the graph, played by a test."""

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from nodes_bench import Bench
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.arm.arm import Arm
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import joints_message
from longarm_comp.nodes.orders import order_id
from longarm_interfaces.msg import DriverState, Motion


class Driver:
    """Tells a state twice a second and answers trajectories as it is set to.

    It hears what is withdrawn, too: one made later may miss the first message of others.
    """

    def __init__(self, stage: Bench, arm: Arm) -> None:
        self.stage, self.arm = stage, arm
        self.state, self.event = DriverState.READY, Motion.ACCEPTED
        self.stops = 0
        self.instances: tuple[str, ...] = ()
        self.answers = True
        self.got: list[JointTrajectory] = []
        self.withdrawn: list[str] = []
        self._states = graph.DRIVER_STATE.publisher(stage.node)
        self._motions = graph.MOTION.publisher(stage.node)
        self._joints = graph.JOINT_STATES.publisher(stage.node)
        graph.JOINT_TRAJECTORY.subscription(stage.node, self._on_trajectory)
        graph.WITHDRAWN.subscription(stage.node, lambda told: self.withdrawn.append(told.data))
        stage.node.create_timer(0.2, self.beat)

    def says(self, state: int) -> None:
        """It is in that state from now on, and says so at once."""
        self.state = state
        self.beat()

    def beat(self) -> None:
        """Tell the state, and where the joints are."""
        for instance in self.instances:
            told = DriverState(state=self.state, message="so", instance=instance, stops=self.stops)
            self._states.publish(told)
        self._joints.publish(joints_message(self.arm, self.arm.mid))

    def _on_trajectory(self, message: JointTrajectory) -> None:
        self.got.append(message)
        if self.answers:
            self.tell(self.event, order_id(message), message)
        else:
            self.tell(Motion.REFUSED, "a trajectory of another one")

    def tell(self, event: int, name: str, taken: JointTrajectory | None = None) -> None:
        motion = Motion(id=name, event=event, message="the fake says so")
        if event == Motion.ACCEPTED and taken is not None:
            names = list(self.arm.joint_names)
            motion.start = JointState(name=names, position=self.arm.mid.tolist())
            motion.points = taken.points
        self._motions.publish(motion)


def is_away(
    stage: Bench, process: subprocess.Popen[str], pause_s: float, *sent: Callable[[], object]
) -> None:
    """Freeze a node while all of this is sent; the played driver goes on telling its state."""
    process.send_signal(signal.SIGSTOP)
    state = Path(f"/proc/{process.pid}/stat")
    stage.spin(lambda: state.read_text().rpartition(")")[2].split()[0] == "T")
    for send in sent:
        send()
        by = time.monotonic() + pause_s
        while time.monotonic() < by:
            stage.executor.spin_once(timeout_sec=0.02)
    process.send_signal(signal.SIGCONT)
