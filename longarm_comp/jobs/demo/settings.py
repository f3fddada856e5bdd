"""What the demonstration does, and the graph that it does it on."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from longarm_comp.jobs.demo.table import NAMES
from longarm_comp.jobs.loop.settings import LoopSettings
from longarm_comp.jobs.pace import Pace
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.share import folder

NAMESPACE = "longarm_demo"
"""Its own namespace: apart from any real arm on the same network."""

PACE = Pace(sightings=3, dwell_s=0.08, move_s=0.05, arrive_s=60.0, look_s=30.0, tolerance=2e-4)
_PATIENCE_S = 30.0
"""Age of an order: on a busy machine one waits for seconds, and no simulated arm does harm."""


@dataclass(frozen=True)
class DemoSettings:
    """One demonstration.

    Attributes:
        poses: to measure, from random sides. targets: fresh ones to judge by.
        hidden: undeclared effects of the simulated arm, ``name=mm``.
        speed: motion so many times faster than the servos' file says.
        seed: of the hidden effects, the plan and the targets.
        more_play: what the arm's play grows by before a second round, ``joint=rad``; empty: no
            second round.
    """

    out: Path
    poses: int = 120
    targets: int = 40
    hidden: str = "joint_compliance=8.0 backlash=3.0"
    speed: float = 20.0
    seed: int = 1
    arm: Path = field(default_factory=lambda: folder("config") / "arm_demo_steps.yaml")
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    more_play: str = ""

    def __post_init__(self) -> None:
        _ = self.loop  # its settings are checked

    @property
    def loop(self) -> LoopSettings:
        """The loop that is run on the graph."""
        return LoopSettings(
            self.out, 1, self.poses, self.targets, seed=self.seed, pace=PACE, names=NAMES
        )

    @property
    def bag(self) -> Path:
        """Session that was collected."""
        return self.out / "session"

    @property
    def model(self) -> Path:
        """Calibrated model with the effects that the diagnosis found."""
        return self.out / "model.yaml"

    @property
    def predictor(self) -> Path:
        """Learned residual."""
        return self.out / "predictor.npz"

    def graph(self) -> BringUp:
        """The graph; model and predictor are taken up once they are there."""
        given: dict[str, dict[str, Any]] = {
            "servo_driver": {"follower.blend_s": 0.05, "order_max_age_s": _PATIENCE_S},
            "simulated_arm": {
                "hidden": self.hidden, "seed": self.seed, "frame_rate_hz": 20.0,
            },
            "kinematics": {"move_time_s": PACE.move_s, "target_max_age_s": _PATIENCE_S},
        }  # fmt: skip
        for node, more in self.parameters.items():
            given[node] = {**given.get(node, {}), **more}
        return BringUp(
            arm=self.arm,
            model=self.model,
            predictor=self.predictor,
            sim=True,
            namespace=NAMESPACE,
            speed=self.speed,
            set=given,
        )
