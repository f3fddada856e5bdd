"""Faults of a soak test, one class each: it breaks something and repairs it."""

import math
import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool, Trigger

from longarm_comp.core.files import write_text
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_of
from soak.scene import Scene

_BROKEN_S = 1.5


class Fault(Protocol):
    """Interface of a fault."""

    @property
    def name(self) -> str:
        """In the report."""

    def strike(self, scene: Scene) -> None:
        """Cause the fault and end it, or leave a state that recovers by itself."""


@dataclass(frozen=True)
class Kill:
    """SIGKILL of a node, which the supervisor restarts. With ``quiet`` no target is in work then.

    A killed process cannot answer the target that it works on. So the kinematics node is killed
    between targets, and the driver after its counters were checked.
    """

    node: str
    quiet: bool = False

    @property
    def name(self) -> str:
        """In the report."""
        return f"kill {self.node}"

    def strike(self, scene: Scene) -> None:
        """Kill the node; with ``quiet``, wait until it is back."""
        if self.quiet:
            scene.audit()
        before = scene.supervisor.pid(self.node)
        scene.expected_deaths[self.node] += 1
        os.kill(before, signal.SIGKILL)
        if self.quiet:
            scene.wait_back(self.node, before)


@dataclass(frozen=True)
class BreakFile:
    """Overwrites a file with invalid contents, then restores it."""

    path: Path

    @property
    def name(self) -> str:
        """In the report."""
        return f"break {self.path.name}"

    def strike(self, scene: Scene) -> None:
        """Break and restore the file. Targets go on: the last good version is used."""
        good = self.path.read_bytes()
        write_text(self.path, "rubbish: [")
        scene.go_on(_BROKEN_S)
        partial = self.path.with_suffix(".good")
        partial.write_bytes(good)
        partial.replace(self.path)


@dataclass(frozen=True)
class Freeze:
    """Halts a node for a while. What it left the driver in is then reset, as a person would."""

    node: str
    seconds: float

    @property
    def name(self) -> str:
        """In the report."""
        return f"freeze {self.node}"

    def strike(self, scene: Scene) -> None:
        """Halt the process and let it go on. Targets go on meanwhile."""
        pid = scene.supervisor.pid(self.node)
        os.kill(pid, signal.SIGSTOP)
        try:
            scene.go_on(self.seconds)
        finally:
            os.kill(pid, signal.SIGCONT)
        scene.reset()


@dataclass(frozen=True)
class ClockFault:
    """/clock goes at another rate for a while, or jumps."""

    name: str
    rate: float = 1.0
    jump_s: float = 0.0

    def strike(self, scene: Scene) -> None:
        """Change the clock; targets go on. It then goes on at its rate from where it is."""
        scene.clock.jump(self.jump_s)
        scene.clock.rate = self.rate
        scene.go_on(_BROKEN_S)
        scene.clock.rate = 1.0


@dataclass(frozen=True)
class RubbishParameters:
    """Parameters of every node are set to what they do not allow; each must be refused."""

    name: str = "rubbish parameters"

    def strike(self, scene: Scene) -> None:
        """Set them, one after another."""
        for node, parameter, value in _RUBBISH:
            if node not in scene.supervisor.commands:
                continue
            client = scene.client.node.create_client(SetParameters, f"{node}/set_parameters")
            wanted = Parameter(parameter, value=value).to_parameter_msg()
            request = SetParameters.Request(parameters=[wanted])
            (result,) = scene.client.call(client, request, again=True).results
            if result.successful or not result.reason:
                scene.ledger.wrong[f"{node} took {parameter} {value!r}"] += 1
            scene.client.node.destroy_client(client)


_RUBBISH: tuple[tuple[str, str, object], ...] = (
    ("kinematics", "method", "rubbish"),
    ("kinematics", "run_up", 3),
    ("kinematics", "arm", "/nowhere.yaml"),
    ("kinematics", "markers.sag_factor", math.nan),
    ("kinematics", "unheard_of", 1),
    ("error_predictor", "predictor", 7.5),
    ("servo_driver", "rate_hz", -1.0),
    ("stereo_bridge", "queue", "many"),
    ("simulated_arm", "more_play", "elbow of joint 4"),
)


@dataclass(frozen=True)
class BadImages:
    """Images that are cut short, of another size or of no known encoding, and none in between."""

    name: str = "bad images"

    def strike(self, scene: Scene) -> None:
        """Publish them beside those of the cameras."""
        node = scene.client.node
        sides = [topic.publisher(node) for topic in (graph.LEFT_IMAGE, graph.RIGHT_IMAGE)]
        scene.client.spin(0.5)  # discovery
        for encoding, width, held in (("mono8", 8, 3), ("mono8", 5, 25), ("smell", 4, 16)):
            for side in sides:
                image = Image(height=width, width=width, step=width, encoding=encoding)
                image.data = bytes(held)
                image.header.stamp = stamp_of(scene.clock.stamp_ns())
                side.publish(image)
        scene.go_on(_BROKEN_S)
        for side in sides:
            node.destroy_publisher(side)


@dataclass(frozen=True)
class Hold:
    """The arm is held, then let go on. Nothing is sent to the driver in between."""

    name: str = "hold"

    def strike(self, scene: Scene) -> None:
        """Hold and let go. Targets go on meanwhile."""
        client = graph.HOLD.client(scene.client.node, of="servo_driver")
        scene.client.call(client, SetBool.Request(data=True), again=True)
        scene.go_on(_BROKEN_S)
        scene.client.call(client, SetBool.Request(data=False), again=True)


@dataclass(frozen=True)
class EmergencyStop:
    """Emergency stop, then release. The driver refuses and reports commands in between."""

    name: str = "emergency stop"

    def strike(self, scene: Scene) -> None:
        """Stop and release. Targets go on meanwhile."""
        client = graph.ESTOP.client(scene.client.node, of="servo_driver")
        if not client.wait_for_service(timeout_sec=0.0):
            return
        client.call_async(SetBool.Request(data=True))
        scene.go_on(_BROKEN_S)
        client.call_async(SetBool.Request(data=False))


@dataclass(frozen=True)
class Flood:
    """Far more targets than anybody can follow."""

    name: str = "flood"

    def strike(self, scene: Scene) -> None:
        """Send them all at once."""
        scene.flood(2000)


@dataclass(frozen=True)
class LearningStopped:
    """What was learned at work is undone, and nothing is learned for a while."""

    name: str = "learning stopped"

    def strike(self, scene: Scene) -> None:
        """Undo and freeze, then let it learn again. Targets go on meanwhile."""
        for service, request in (
            (graph.UNDO, Trigger.Request()),
            (graph.FREEZE, SetBool.Request(data=True)),
            (graph.FREEZE, SetBool.Request(data=False)),
        ):
            client = service.client(scene.client.node, of="kinematics")
            done = scene.client.call(client, request, again=True)
            if not done.success:
                scene.ledger.wrong[f"kinematics refused {service.name}: {done.message}"] += 1
            scene.client.node.destroy_client(client)
            scene.go_on(_BROKEN_S)


@dataclass(frozen=True)
class PathSent:
    """A planned path between the targets."""

    name: str = "path"

    def strike(self, scene: Scene) -> None:
        """Send it and see how it ends."""
        scene.path(points=21, seconds=1.0)
