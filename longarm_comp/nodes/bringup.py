"""Starts and supervises the nodes of an arm's graph, for `longarm up` and launch files.

A program can start the graph itself::

    with running(BringUp(arm=Path("arm.yaml"), sim=True)):
        ...
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from longarm_comp.arm_folder.make import parameter_files
from longarm_comp.arm_folder.measured import CAMERAS, SIDES
from longarm_comp.arm_folder.parameter_file import own_parameters, read_parameters
from longarm_comp.arm_folder.servos import find_contradictions
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.files import write_text
from longarm_comp.core.processes import run_module
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.devices.kept_turns import TURNS
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.nodes import EFFECTS, GUARD, NETWORK
from longarm_comp.share import PACKAGE, folder
from longarm_comp.sim.servo_emulator.joints import read_arm

_GENTLE_S, _FIRM_S = 6.0, 2.0
"""Longest wait for a process to end after SIGINT, then after SIGTERM, s.

The first is long because the driver reads every servo and switches it off.
"""


@dataclass
class Supervisor:
    """A supervisor of processes, and a context manager.

    If another process ends for good, the servo driver goes on, because it holds the arm up.
    """

    commands: Mapping[str, Sequence[str]]  # program and arguments of each process, by its name
    respawn: bool = True  # restart a process that ends, except after exit code 2 (bad input)
    say: Callable[[str], None] = lambda text: None  # called with a message on every start and end
    gone: dict[str, str] = field(default_factory=dict)  # how each process ended that stays ended
    _children: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    _begun: dict[str, float] = field(default_factory=dict)  # start of each process, monotonic s

    def __enter__(self) -> Supervisor:
        try:
            for name in self.commands:
                self._start_process(name, "started")
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *ending: object) -> None:
        self.stop()

    def pid(self, name: str) -> int:
        return self._children[name].pid

    def _start_process(self, name: str, why: str) -> None:
        """Start a process in a session of its own, so that Ctrl-C reaches only the supervisor."""
        self._begun[name] = time.monotonic()
        self._children[name] = subprocess.Popen(
            self.commands[name],
            env={**os.environ, GUARD: str(os.getpid())},
            start_new_session=True,
            stdin=subprocess.DEVNULL,
        )
        self.say(f"{name} {why}, pid {self.pid(name)}")

    def look(self) -> None:
        """Restart the processes that ended, or report once that a process stays ended.

        Raises:
            JobError: the driver stays ended, or no process is left.
        """
        for name, child in self._children.items():
            code = child.poll()
            if code is None or name in self.gone:
                continue
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            if code == InputError.exit_code or not self.respawn:
                self.gone[name] = how
                if name == _DRIVER or len(self.gone) == len(self._children):
                    raise JobError(f"{name} ended ({how})")
                self.say(f"{name} ended ({how}) and is not started again; the other nodes go on")
            elif time.monotonic() - self._begun[name] >= 1.0:
                self._start_process(name, f"ended ({how}), started again")

    def run(self, stop: threading.Event) -> None:
        """Restart processes that end until the event is set; JobError if one stayed ended."""
        while not stop.wait(0.2):
            self.look()
        if self.gone:
            ended = ", ".join(f"{name} ({how})" for name, how in self.gone.items())
            raise JobError(f"ended before the others: {ended}")

    def stop(self) -> None:
        """End all processes by SIGINT, then SIGTERM, then SIGKILL; return when all are gone."""
        processes = list(self._children.values())
        for number, patience in ((signal.SIGINT, _GENTLE_S), (signal.SIGTERM, _FIRM_S)):
            for process in processes:
                process.send_signal(number)
            deadline = time.monotonic() + patience
            for process in processes:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, deadline - time.monotonic()))
        for process in processes:
            process.kill()
            process.wait()


_DRIVER = "servo_driver"
REAL = ("error_predictor", "kinematics", _DRIVER, "stereo_bridge")
SIMULATED = ("simulated_arm", *REAL)
PATHS = "trajectory_compensator"
"""The node that is started if `BringUp.paths` is True."""

_PATIENT = {"bus.reply_timeout_s": 0.2, "follower.silence_s": 2.5, "patience_s": 60.0}
"""Longer timeouts, s, for emulated servos: they start with the driver and share its computer."""


@dataclass(frozen=True)
class BringUp:
    """The settings of one arm's graph.

    Attributes:
        driver: whether `servo_driver` runs. If not, another program drives the arm, and
            `stereo_bridge` runs only if the folder has the calibration of a camera pair.
    """

    arm: Path  # arm.yaml
    model: Path | None = None  # its file; None: the arm as declared
    predictor: Path | None = None  # its file; None: no learned error is compensated
    effects: tuple[Path, ...] = ()  # Python files that `kinematics` and `PATHS` execute
    network: Path | None = None  # Python file that `error_predictor` executes
    sim: bool = False  # the simulated arm runs instead of hardware
    namespace: str = ""  # of the graph; empty for none
    config: Path | None = None  # folder of <node>.yaml that replace the package's; None: the arm's
    port: str = ""  # serial port of the servos; empty: the port in the parameter file
    speed: float = 1.0  # factor on all velocities in simulation
    set: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # by node and parameter
    without: tuple[str, ...] = ()  # nodes that are not started
    driver: bool = True
    paths: bool = False  # `PATHS` runs too
    shaping: bool = False  # `servo_driver` splits moves so that the arm rings little afterwards

    def __post_init__(self) -> None:
        for name in (*self.set, *self.without):
            if name not in (*SIMULATED, PATHS):
                raise InputError("bring-up", "node", name, ", ".join((*SIMULATED, PATHS)))
        if not self.driver:
            for name in ("sim", "port", "shaping"):
                if getattr(self, name):
                    allowed = "none without the driver of this package"
                    raise InputError("bring-up", name, getattr(self, name), allowed)
        if not 0.01 <= self.speed <= 100.0:
            raise InputError("bring-up", "speed", self.speed, "0.01 to 100")

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes, in the order of starting."""
        every = (*(SIMULATED if self.sim else REAL), *((PATHS,) if self.paths else ()))
        unasked = () if self.driver else (_DRIVER, *(() if self.cameras else ("stereo_bridge",)))
        return tuple(n for n in every if n not in (*self.without, *unasked))

    def file(self, node: str) -> Path:
        """Return a node's parameter file: from ``config`` or the arm's folder, or the package's."""
        name = f"{node}.yaml"
        own = (self.config or self.arm.absolute().parent) / name
        return own if own.is_file() else folder("config") / name

    @property
    def cameras(self) -> Path | None:
        """The folder with the camera pair's calibration, beside the parameter files; or None."""
        own = (self.config or self.arm.absolute().parent) / CAMERAS
        return own if all((own / f"{side}.yaml").is_file() for side in SIDES) else None

    def with_servos(self, scratch: Path) -> BringUp:
        """Check the parameter files and return this graph with servos that fit the arm's joints.

        If the package's servos do not fit a simulated arm, parameter files that do are written to
        the folder ``scratch``, together with those that the arm's folder has.

        Raises:
            InputError: a real arm has no servo file of its own, its servos contradict arm.yaml, or
                a parameter file names Python files.
        """
        for node in self.nodes:
            _refuse_code(self.file(node))
        file, arm = self.file("servo_driver"), Arm.load(self.arm)
        if not self.driver:
            return self
        if self.sim:
            read_arm(file)  # servos that cannot be emulated are refused here, not in five processes
        own = self.config or self.arm.absolute().parent
        hint = f"longarm init DIR --arm {self.arm} writes files that fit"
        if not self.sim and not (own / file.name).is_file():
            allowed = f"servo ids, zeros and limits of this arm; {hint}"
            raise InputError(own, file.name, "missing", allowed)
        servos = ServoConfig.load(file)
        error = next(find_contradictions(servos, arm, str(file), str(self.arm)), None)
        if error is None:
            return self
        if not self.sim or file != folder("config") / file.name:
            raise InputError(error.where, error.field, error.value, f"{error.allowed}; {hint}")
        for node, text in parameter_files(arm).items():
            write_text(scratch / f"{node}.yaml", text)
        for node in self.nodes:
            given = own / f"{node}.yaml"
            if given.is_file():
                write_text(scratch / given.name, given.read_text("utf-8"))
        return replace(self, config=scratch)

    def parameters(self, node: str, bus: str) -> dict[str, Any]:
        """Return a node's parameters that override its file; ``bus``: link to the simulated bus."""
        arm, model = _path_parameter("arm", self.arm), _path_parameter("model", self.model)
        if not self.driver and node in ("kinematics", PATHS):
            return arm | model | {"acknowledged": False} | dict(self.set.get(node, {}))
        file = self.file("servo_driver")
        servos = _path_parameter("servos", file)
        driver = {**read_parameters(file), **self.set.get("servo_driver", {})}
        trimmed = {"trimmed": True} if driver.get("trim") else {}
        shaped = {"shaped": True} if self.shaping else {}
        shaping = {"shaping": True} | model if self.shaping else {}
        wire = bus if self.sim else self.port
        port = {"bus.port": wire} if wire else {}
        emulated: dict[str, Any] = {}
        learned: dict[str, Any] = {}
        if self.sim:
            # A folder of its own: a simulated arm ends no stop of a real one and teaches it nothing
            state = state_folder() / "simulated" / os.environ.get("ROS_DOMAIN_ID", "0")
            # Emulated servos have nothing stored: they are as from the factory
            stored = {name: 0 for name in driver if ".stored." in name}
            zeros = {f"joints.{j.name}.zero_ticks": j.zero_ticks for j in read_arm(file).joints}
            emulated = stored | (zeros if stored else {}) | _PATIENT | {"state": str(state)}
            name = self.namespace.strip("/").replace("/", ".") or "model"
            learned = {"learned_file": str(state / f"{name}.at_work.json")}
        values: dict[str, Any] = {
            "kinematics": arm | servos | model | trimmed | shaped | learned,
            "error_predictor": arm | model | _path_parameter("predictor", self.predictor),
            "servo_driver": arm | shaping | port | emulated,
            "stereo_bridge": {} if self.sim else _path_parameter("cameras", self.cameras),
            PATHS: arm | model,
            "simulated_arm": arm | servos | {"port": bus},
        }[node]
        if self.sim and self.speed != 1.0:
            values |= self._scale_speeds(node)
        return values | dict(self.set.get(node, {}))

    def _scale_speeds(self, node: str) -> dict[str, Any]:
        """Return the parameters of a node that depend on ``speed``, scaled for a simulation."""
        if node not in ("servo_driver", "simulated_arm", "kinematics"):
            return {}
        speed, given = float(self.speed), read_parameters(self.file(node))
        usual = own_parameters(node) | given
        if node == "kinematics":
            return {"joints_max_rate": speed * usual["joints_max_rate"]}
        if node == "simulated_arm":
            faster = speed * usual["speed_ticks_s"]
            return {"speed_ticks_s": faster, "lag_s": usual["lag_s"] / speed}
        longest = usual["follower.max_step_s"]
        joints = ServoConfig.load(self.file(node)).joints
        # A moving joint lags by its velocity times the driver's cycle, so more counts as following,
        # up to the driver's bound. The longest time step is shorter, because readings that differ
        # by more than half a turn are not believed
        half_turn = min(joint.servo.ticks_per_turn for joint in joints.values()) / 2
        lost = speed * usual["follower.lost_error_ticks"]
        tops = {
            f"joints.{name}.top_speed_ticks_s": speed * joint.fastest_ticks_s
            for name, joint in joints.items()
            if math.isfinite(joint.fastest_ticks_s)
        }
        return {
            "follower.lost_error_ticks": min(lost, half_turn),
            "follower.max_step_s": min(longest, max(longest / speed, 1.0 / usual["rate_hz"])),
            **{name: speed * v for name, v in given.items() if name.endswith(".max_velocity")},
            **tops,
        }

    def files(self, node: str, bus: str, scratch: Path) -> list[Path]:
        """Return a node's own parameter file, then one written to ``scratch`` that overrides it."""
        if node == "simulated_arm":  # its servos start at home, whatever another run's counted
            state = Path(self.parameters("servo_driver", bus)["state"])
            shutil.rmtree(state / TURNS, ignore_errors=True)
        values = {f"/**/{node}": {"ros__parameters": self.parameters(node, bus)}}
        write_text(scratch / f"{node}.given.yaml", yaml.safe_dump(values))
        return [self.file(node), scratch / f"{node}.given.yaml"]

    def arguments(self, node: str) -> list[str]:
        """Return a node's command-line arguments: the Python files that it executes."""
        if node == "error_predictor":
            return [NETWORK, str(self.network.absolute())] if self.network else []
        loads = self.effects if node in ("kinematics", PATHS) else ()
        return [word for path in loads for word in (EFFECTS, str(path.absolute()))]

    def commands(self, scratch: Path) -> dict[str, list[str]]:
        """Return program and arguments of every node, by name.

        Parameter files are written to the folder ``scratch``; the simulated bus is linked there.
        """
        bus = str(scratch / "servo_bus")
        space = ["-r", f"__ns:=/{self.namespace.strip('/')}"] if self.namespace else []
        made = {}
        for name in self.nodes:
            made[name] = run_module(f"{PACKAGE}.nodes.{name}")
            made[name] += [*self.arguments(name), "--ros-args", *space]
            for file in self.files(name, bus, scratch):
                made[name] += ["--params-file", str(file)]
        return made


def _path_parameter(name: str, path: Path | None) -> dict[str, Any]:
    """Return the parameter ``name`` with an absolute path; no parameter for None."""
    return {} if path is None else {name: str(path.absolute())}


def _refuse_code(file: Path) -> None:
    """Refuse a parameter file that names Python files, at any depth: only a command line may."""
    ahead = [read_yaml(file)]
    while ahead:
        tree = ahead.pop()
        if isinstance(tree, dict):
            for option in (EFFECTS, NETWORK):
                if (name := option.removeprefix("--")) in tree:
                    allowed = f"nothing: Python files are executed only for {option} FILE"
                    raise InputError(file, name, tree[name], f"{allowed} of a command line")
            ahead += tree.values()


@contextmanager
def running(
    graph: BringUp, *, respawn: bool = True, say: Callable[[str], None] = lambda text: None
) -> Iterator[Supervisor]:
    """Start the graph's processes; end all of them on exit, also after an exception.

    ``respawn`` and ``say`` are those of `Supervisor`.
    """
    with tempfile.TemporaryDirectory(prefix="longarm_") as scratch:
        graph = graph.with_servos(Path(scratch))
        with Supervisor(graph.commands(Path(scratch)), respawn=respawn, say=say) as supervisor:
            yield supervisor
