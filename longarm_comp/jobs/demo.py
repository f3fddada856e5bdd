"""The demonstration: a simulated arm on a graph of its own, and the loop on it."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.calibrate import Errors
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.jobs.loop.run import Loop, write_loop
from longarm_comp.jobs.loop.settings import LoopSettings, Names
from longarm_comp.jobs.targets import Trial
from longarm_comp.nodes.bringup import BringUp, running
from longarm_comp.nodes.simulated_arm import sizes
from longarm_comp.nodes.stamps import stamp_ns
from longarm_comp.share import folder
from longarm_comp.sim.plant import hidden_effects
from longarm_comp.workflows.inputs import MODEL, PREDICTOR, load_predictor
from longarm_interfaces.srv import Compensate

ORIGINAL, DECLARED, FOUND, LEARNED = (
    "original", "declared", "effect found", "effect found + network",
)  # fmt: skip
"""Nothing compensated; the declared deflection; the diagnosed model; that and the network."""

NAMES = Names(ORIGINAL, DECLARED, FOUND, LEARNED)

_PAPER = {ORIGINAL: (17.70, 223.94), DECLARED: (15.39, 215.97), LEARNED: (9.98, 180.81)}
"""Table I, 300 samples: mean of the absolute error (mm) and its variance (mm^2)."""


def table_row(trial: Trial) -> dict[str, Any]:
    """What the cameras measured, what really was, what the paper has."""
    seen, true = Errors.of(trial.error), Errors.of(trial.true_error)
    mean, variance = _PAPER.get(trial.name, (None, None))
    return {
        "model": trial.name,
        "n": seen.n,
        "mean_mm": 1e3 * seen.mean,
        "rms_mm": 1e3 * seen.rms,
        "max_mm": 1e3 * seen.max,
        "mean_abs_z_mm": 1e3 * seen.mean_abs_z,
        "variance_mm2": 1e6 * seen.variance,
        "true_mean_mm": 1e3 * true.mean,
        "paper_mean_mm": mean,
        "paper_variance_mm2": variance,
    }


def improved(trials: Sequence[Trial]) -> bool:
    """Whether the last trial came nearer to the targets than the first, measured and truly."""
    first, last = trials[0], trials[-1]
    return (
        Errors.of(last.error).mean < Errors.of(first.error).mean
        and Errors.of(last.true_error).mean < Errors.of(first.true_error).mean
    )


NAMESPACE = "longarm_demo"
"""Its own namespace: apart from any real arm on the same network."""

PACE = Pace(sightings=3, dwell_s=0.08, move_s=0.05, arrive_s=60.0, look_s=30.0, tolerance=2e-4)
_PATIENCE_S = 30.0
"""Age of an order: on a busy machine one waits for seconds, and no simulated arm does harm."""


@dataclass(frozen=True)
class DemoSettings:
    """One demonstration.

    `hidden`: undeclared effects of the simulated arm, ``name=mm``. `speed`: motion so many times
    faster than the servos' file says.
    """

    out: Path
    poses: int = 120
    targets: int = 40
    hidden: str = "joint_compliance=8.0 backlash=3.0"
    speed: float = 20.0
    seed: int = 1
    arm: Path = field(default_factory=lambda: folder("config") / "arm_demo_steps.yaml")

    def __post_init__(self) -> None:
        _ = self.loop  # its settings are checked

    @property
    def loop(self) -> LoopSettings:
        """The loop that is run on the graph."""
        return LoopSettings(
            self.out, 1, self.poses, self.targets, seed=self.seed, pace=PACE, names=NAMES
        )

    def graph(self) -> BringUp:
        """The graph; model and predictor are taken up once they are there."""
        given: dict[str, dict[str, Any]] = {
            "servo_driver": {"follower.blend_s": 0.05, "order_max_age_s": _PATIENCE_S},
            "simulated_arm": {
                "hidden": self.hidden, "seed": self.seed, "frame_rate_hz": 10.0,
            },
            "kinematics": {"move_time_s": PACE.move_s, "target_max_age_s": _PATIENCE_S},
        }  # fmt: skip
        return BringUp(
            arm=self.arm, model=self.out / MODEL, predictor=self.out / PREDICTOR, sim=True,
            namespace=NAMESPACE, speed=self.speed, set=given,
        )  # fmt: skip


class _TrueTip:
    """Listens to `simulated_arm/true_tip`; a `Witness` of `TargetRunner`."""

    def __init__(self, client: ArmClient) -> None:
        self._client = client
        self._heard: list[tuple[int, np.ndarray]] = []
        client.node.create_subscription(PointStamped, "simulated_arm/true_tip", self._hear, 20)

    def _hear(self, message: PointStamped) -> None:
        p = message.point
        self._heard.append((stamp_ns(message.header.stamp), np.array([p.x, p.y, p.z])))
        del self._heard[:-20]

    def __call__(self, after_ns: int) -> np.ndarray:
        """The tip (3,), m, after a time (ns)."""
        self._client.until(
            lambda: self._heard and self._heard[-1][0] > after_ns, 10.0,
            "no true_tip of the simulation",
        )  # fmt: skip
        return self._heard[-1][1]


Say = Callable[[str, float], None]


def demonstrate(
    settings: DemoSettings, stop: threading.Event, say: Say = lambda text, share: None
) -> dict[str, Any]:
    """Run the whole loop; what came of it, for --json and the file in the folder.

    Every process has ended when this returns or raises.
    """
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
        client = stack.enter_context(ArmClient(arm, NAMESPACE, stop, "demo"))
        say("bring up", 0.0)
        witness = _TrueTip(client)

        loop = Loop(client, settings.loop, lambda report: True, witness=witness, say=say)
        first = loop.run(120.0)  # five processes start; on a busy machine that takes its time
        write_loop(arm.name, settings.loop, first)
        inputs: list[str] = []
        model, predictor = settings.out / MODEL, settings.out / PREDICTOR
        if predictor.is_file():  # nothing is trained where nothing was applied
            inputs = list(load_predictor(predictor, arm, model).encoding.names)
        for name in ("report.html", "report.json"):
            shutil.copyfile(settings.loop.path("diagnosis", 1) / name, settings.out / name)
    found, seconds = first.rounds[0], {k.removesuffix("_1"): v for k, v in first.seconds.items()}
    return {
        "rows": [table_row(trial) for trial in first.trials],
        "improved": improved(first.trials),
        "collected": found["collected"],
        "outside_training_data": first.trials[-1].count(Compensate.Response.OUT_OF_DOMAIN),
        "verdict": found["verdict"],
        "diagnosis": found["found"],
        "effects_found": found["effects_found"],
        "network_inputs": inputs,
        "network_refused": (found["applied"] or {}).get("network_refused", ""),
        "hidden": settings.hidden,
        "seed": settings.seed,
        "seconds": {**seconds, "total": sum(seconds.values())},
        "files": {
            "session": str(settings.out / "session"),
            "model": str(model),
            "predictor": str(predictor),
            **{name: str(settings.out / f"{name}.html") for name in ("report", "loop")},
        },
    }


_LOGS = "log"


def prepare(settings: DemoSettings) -> None:
    """Make the folder. The logs that a start that failed has left in it are no obstacle."""
    out = settings.out
    if out.exists() and (not out.is_dir() or {p.name for p in out.iterdir()} - {_LOGS}):
        raise InputError("demo", "--out", out, "a new or empty folder")
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = error.strerror or str(error)
        raise InputError(settings.out, "--out", why, "a folder to write in") from error
    os.environ.setdefault("ROS_LOG_DIR", str(settings.out.absolute() / _LOGS))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
