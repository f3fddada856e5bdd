"""The demonstration: a simulated arm on a graph of its own, and the loop on it."""

import os
import shutil
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import check_writable
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.jobs.loop import Loop, LoopSettings, Names
from longarm_comp.jobs.targets import Say, Trial, Witness
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import BringUp, running
from longarm_comp.nodes.clock import stamp_ns
from longarm_comp.nodes.simulated_arm import sizes
from longarm_comp.share import folder
from longarm_comp.sim.plant import hidden_effects
from longarm_comp.workflows.inputs import MODEL, PREDICTOR, load_predictor

ORIGINAL, DECLARED, FOUND, LEARNED = NAMES = (
    "original",
    "declared",
    "effect found",
    "effect found + network",
)
"""Names of the runs: without compensation; with the declared deflection; with the diagnosed model;
with this model and the network."""

_PAPER = {ORIGINAL: (17.70, 223.94), DECLARED: (15.39, 215.97), LEARNED: (9.98, 180.81)}
"""Table I, 300 samples: mean of the absolute error (mm) and its variance (mm^2)."""


def table_row(trial: Trial) -> dict[str, Any]:
    """Return a table row: errors by the cameras, the true mean error, and the paper's errors."""
    seen = Errors.of(trial.error)
    told = ("mean_mm", "rms_mm", "max_mm", "mean_abs_z_mm", "variance_mm2")
    mean, variance = _PAPER.get(trial.name, (None, None))
    return {
        "model": trial.name,
        "n": seen.n,
        **{key: seen.mm[key] for key in told},
        "true_mean_mm": Errors.of(trial.true_error).mm["mean_mm"],
        "paper_mean_mm": mean,
        "paper_variance_mm2": variance,
    }


def is_improved(trials: Sequence[Trial]) -> bool:
    """Tell whether the mean error fell from the first to the last trial, as seen and in truth."""
    first, last = table_row(trials[0]), table_row(trials[-1])
    return all(last[name] < first[name] for name in ("mean_mm", "true_mean_mm"))


NAMESPACE = "longarm_demo"
"""A namespace of its own, apart from any real arm on the same network."""

PACE = Pace(sightings=3, dwell_s=0.05, move_s=0.05, look_s=30.0, tolerance=2e-4)
"""Short waits. Orders may be `look_s` old: a busy machine is slow, a simulated arm does no harm."""


@dataclass(frozen=True)
class DemoSettings:
    """The settings of one demonstration."""

    out: Path
    poses: int = 120
    targets: int = 40
    hidden: str = "joint_compliance=8.0 backlash=3.0"  # undeclared effects of the arm, ``name=mm``
    speed: float = 20.0  # factor by which motions are faster than the servo file says
    seed: int = 1
    arm: Path = field(default_factory=lambda: folder("config") / "arm_demo_steps.yaml")

    def __post_init__(self) -> None:
        _ = self.loop  # its settings are checked

    @property
    def loop(self) -> LoopSettings:
        sizes = 1, self.poses, self.targets
        return LoopSettings(self.out, *sizes, seed=self.seed, pace=PACE, names=Names(*NAMES))

    def graph(self) -> BringUp:
        """Return the graph to start. Its nodes read model and predictor once these files exist."""
        given: dict[str, dict[str, Any]] = {
            "servo_driver": {
                "follower.blend_s": 0.05,
                "order_max_age_s": PACE.look_s,
                "state": str(self.out.absolute() / "state"),  # no other run's stop holds for it
            },
            "simulated_arm": {"hidden": self.hidden, "seed": self.seed, "frame_rate_hz": 15.0},
            "kinematics": {"move_time_s": PACE.move_s, "target_max_age_s": PACE.look_s},
        }
        return BringUp(
            arm=self.arm,
            model=self.out / MODEL,
            predictor=self.out / PREDICTOR,
            sim=True,
            namespace=NAMESPACE,
            speed=self.speed,
            set=given,
        )


def _true_tip(client: ArmClient) -> Witness:
    """Return a function that waits for the tip of the simulation after a time (ns)."""
    heard: deque[tuple[int, np.ndarray]] = deque(maxlen=1)

    def hear(message: PointStamped) -> None:
        p = message.point
        heard.append((stamp_ns(message.header.stamp), np.array([p.x, p.y, p.z])))

    def after(ns: int) -> np.ndarray:
        missing = "no true_tip of the simulation"
        client.until(lambda: heard and heard[0][0] > ns, 10.0, missing)
        return heard[0][1]

    client.node.create_subscription(PointStamped, "simulated_arm/true_tip", hear, 20)
    return after


def demonstrate(
    settings: DemoSettings, stop: threading.Event, say: Say = lambda text, share: None
) -> dict[str, Any]:
    """Run the whole loop, end all its processes, and return the results as data for --json."""
    arm = Arm.load(settings.arm)
    hidden_effects(arm, sizes(settings.hidden), np.random.default_rng(settings.seed))  # checked
    prepare(settings)
    with ExitStack() as stack:
        supervisor = stack.enter_context(running(settings.graph()))
        ended = threading.Event()
        watch = threading.Thread(target=supervisor.run, args=(ended,), daemon=True)
        watch.start()
        stack.callback(watch.join, 5.0)
        stack.callback(ended.set)
        client = stack.enter_context(ArmClient(arm, NAMESPACE, stop, "demo", graph.TIP_SEEN))
        say("bring up", 0.0)
        witness = _true_tip(client)
        loop = Loop(client, settings.loop, lambda report: True, witness=witness, say=say)
        trials, done = loop.run(120.0)  # five processes start; on a busy machine that takes time
        inputs: list[str] = []
        model, predictor = settings.out / MODEL, settings.out / PREDICTOR
        if predictor.is_file():  # nothing is trained where nothing was applied
            inputs = list(load_predictor(predictor, arm, model).encoding.names)
        for name in ("report.html", "report.json"):
            shutil.copyfile(settings.loop.path("diagnosis", 1) / name, settings.out / name)
    (found,) = done["rounds"]
    return {
        "rows": [table_row(trial) for trial in trials],
        "improved": is_improved(trials),
        "collected": found["collected"],
        "outside_training_data": int(np.sum(trials[-1].status == Status.OUT_OF_DOMAIN)),
        "verdict": found["verdict"],
        "diagnosis": found["found"],
        "effects_found": found["effects_found"],
        "network_inputs": inputs,
        "network_refused": (found["applied"] or {}).get("network_refused", ""),
        "hidden": settings.hidden,
        "seed": settings.seed,
        "seconds": {step.removesuffix("_1"): s for step, s in done["seconds"].items()},
        "files": {
            "session": str(settings.out / "session"),
            "model": str(model),
            "predictor": str(predictor),
            **{name: str(settings.out / f"{name}.html") for name in ("report", "loop")},
        },
    }


def prepare(settings: DemoSettings) -> None:
    """Make the output folder, and let ROS write its logs there and stay on this machine.

    Raises:
        InputError: the folder holds more than the logs of a failed start.
    """
    out, logs = settings.out, "log"
    if out.exists() and (not out.is_dir() or {p.name for p in out.iterdir()} - {logs}):
        raise InputError("demo", "--out", out, "a new or empty folder")
    check_writable(out)
    os.environ.setdefault("ROS_LOG_DIR", str(out.absolute() / logs))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
