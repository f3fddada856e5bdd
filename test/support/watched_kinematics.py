"""`kinematics` as its /diagnostics tell of it, and its service."""

from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from nodes_bench import Bench
from std_msgs.msg import Header

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import joints_message, pose_message
from longarm_interfaces.srv import Compensate


class Watched:
    """/diagnostics of `kinematics`, and its service."""

    def __init__(self, stage: Bench, arm: Arm, space: str = "") -> None:
        self.stage, self.arm = stage, arm
        self.heard = stage.collect(graph.DIAGNOSTICS)
        self.client = stage.node.create_client(Compensate, f"{space}/{graph.COMPENSATE.name}")
        self.pose = pose_message(declared_model(arm).pose(arm.mid))

    def part(self, name: str) -> Any:
        """Wait for the next report of a part."""
        del self.heard[:]
        wanted = f"/kinematics: {name}"
        told = lambda: [s for array in self.heard for s in array.status if s.name == wanted]  # noqa: E731
        return self.stage.spin(told)[-1]

    def says(self, name: str, message: str, level: bytes = b"\0") -> None:
        """Wait until a part says that."""

        def said() -> bool:
            status = self.part(name)
            return bool(status.message.startswith(message) and status.level == level)

        self.stage.spin(said)

    @property
    def programs(self) -> int:
        """How many programs are compiled."""
        return next(int(v.value) for v in self.part("ready").values if "programs" in v.key)

    def ask(self, **more: Any) -> Compensate.Response:
        """The answer to one target."""
        header = Header(frame_id="base", stamp=more.pop("stamp", Time()))
        target = PoseStamped(header=header, pose=self.pose)
        seed = joints_message(self.arm, self.arm.mid)
        given = {"target": target, "position_only": True, "seed": seed, **more}
        return self.stage.call(self.client, Compensate.Request(**given))
