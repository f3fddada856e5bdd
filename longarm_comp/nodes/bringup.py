"""Which nodes make an arm's graph, with which files: `longarm up` and the launch files read this.

A program may bring the graph up for itself::

    with running(BringUp(arm=Path("arm.yaml"), sim=True)):
        ...
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from longarm_comp.core.arm.arm import read_yaml
from longarm_comp.core.errors import InputError
from longarm_comp.nodes.supervisor import Supervisor
from longarm_comp.share import PACKAGE, folder

REAL = ("error_predictor", "kinematics", "servo_driver", "stereo_bridge")
SIMULATED = ("simulated_arm", *REAL)

_PATIENT = {"bus.reply_timeout_s": 0.2, "follower.silence_s": 2.0, "patience_s": 60.0}
"""Emulated servos start beside the driver, share the computer with everything and may be late."""


@dataclass(frozen=True)
class BringUp:
    """One arm's graph.

    Attributes:
        arm, model, predictor: files; without a model the arm is as declared.
        effects: Python files that define further effects, executed by `kinematics`.
        sim: with the simulated arm instead of hardware.
        namespace: of the arm; empty: none.
        config: folder of parameter files that replace the package's own, ``<node>.yaml``.
        port: serial port of the servos; the file's by default.
        speed: simulation: how many times faster than the files say all motion is.
        set: further parameters, by node and name.
        without: nodes to leave out.
    """

    arm: Path
    model: Path | None = None
    predictor: Path | None = None
    effects: tuple[Path, ...] = ()
    sim: bool = False
    namespace: str = ""
    config: Path | None = None
    port: str = ""
    speed: float = 1.0
    set: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    without: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in (*self.set, *self.without):
            if name not in SIMULATED:
                raise InputError("bring-up", "node", name, ", ".join(SIMULATED))
        if not 0.01 <= self.speed <= 100.0:
            raise InputError("bring-up", "speed", self.speed, "0.01 to 100")

    @property
    def nodes(self) -> tuple[str, ...]:
        """In the order of starting."""
        return tuple(n for n in (SIMULATED if self.sim else REAL) if n not in self.without)

    def file(self, node: str) -> Path:
        """A node's parameter file: the given folder's where it has one, else the package's."""
        name = f"{node}.yaml"
        own = self.config / name if self.config else None
        return own if own is not None and own.is_file() else folder("config") / name

    def parameters(self, node: str, bus: str) -> dict[str, Any]:
        """What is set on top of the file; ``bus``: link to the simulated servo bus."""
        arm = {"arm": str(self.arm.absolute())}
        servos = str(self.file("servo_driver").absolute())
        port = bus if self.sim else self.port
        per_node: dict[str, dict[str, Any]] = {
            "kinematics": arm | _path("model", self.model) | _paths("effects", self.effects),
            "error_predictor": arm
            | _path("model", self.model)
            | _path("predictor", self.predictor),
            "servo_driver": arm
            | ({"bus.port": port} if port else {})
            | (_PATIENT if self.sim else {}),
            "stereo_bridge": {"reliable_images": True} if self.sim else {},
            "simulated_arm": arm | {"servos": servos, "port": bus},
        }
        made = per_node[node]
        if self.sim and self.speed != 1.0:
            made |= self._faster(node)
        return made | dict(self.set.get(node, {}))

    def _faster(self, node: str) -> dict[str, Any]:
        """Servos and the driver's velocity limits, scaled alike."""
        if node not in ("servo_driver", "simulated_arm"):
            return {}
        given = _ros_parameters(self.file(node))
        if node == "servo_driver":
            return {
                f"joints.{name}.max_velocity": self.speed * float(joint["max_velocity"])
                for name, joint in given.get("joints", {}).items()
            }
        return {
            "speed_ticks_s": self.speed * float(given.get("speed_ticks_s", 3000.0)),
            "lag_s": float(given.get("lag_s", 0.03)) / self.speed,
        }

    def command(self, node: str, bus: str) -> list[str]:
        """The program and its arguments."""
        made = [sys.executable, "-m", f"{PACKAGE}.nodes.{node}", "--ros-args"]
        if self.namespace:
            made += ["-r", f"__ns:=/{self.namespace.strip('/')}"]
        made += ["--params-file", str(self.file(node))]
        for name, value in self.parameters(node, bus).items():
            made += ["-p", f"{name}:={_text(value)}"]
        return made


def _path(name: str, path: Path | None) -> dict[str, Any]:
    return {} if path is None else {name: str(path.absolute())}


def _paths(name: str, paths: tuple[Path, ...]) -> dict[str, Any]:
    return {name: os.pathsep.join(str(p.absolute()) for p in paths)} if paths else {}


def _text(value: Any) -> str:
    """A parameter's value as YAML: texts keep being texts, floats floats."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        quoted = value.replace("'", "''")
        return f"'{quoted}'"
    return repr(value)


def _ros_parameters(path: Path) -> dict[str, Any]:
    data = read_yaml(path)
    for node in (data or {}).values():
        if isinstance(node, dict) and isinstance(node.get("ros__parameters"), dict):
            return dict(node["ros__parameters"])
    raise InputError(path, "ros__parameters", "missing", "a ROS 2 parameter file")


@contextmanager
def running(
    graph: BringUp, *, respawn: bool = True, say: Callable[[str], None] = lambda text: None
) -> Iterator[Supervisor]:
    """The graph's processes, started; all ended at the end, whatever happens.

    Args:
        respawn, say: as `Supervisor` has them.

    Raises:
        InputError: a file is missing or wrong.
    """
    with tempfile.TemporaryDirectory(prefix="longarm_") as scratch:
        bus = str(Path(scratch) / "servo_bus")
        commands = {node: graph.command(node, bus) for node in graph.nodes}
        with Supervisor(commands, respawn=respawn, say=say) as supervisor:
            yield supervisor
