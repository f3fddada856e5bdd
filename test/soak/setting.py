"""Settings of a soak test: duration, rate, faults, graph."""

from dataclasses import dataclass, field
from pathlib import Path

from longarm_comp.core.errors import InputError
from longarm_comp.nodes.bringup import PATHS, SIMULATED, BringUp
from longarm_comp.share import folder

NAMESPACE = "longarm_soak"


@dataclass(frozen=True)
class SoakSettings:
    """Settings of one soak test.

    Attributes:
        out: folder for the files that the nodes read.
        hours, rate_hz: duration, and rate of the targets.
        fault_s: mean time between two faults of the graph.
        bad_share: share of targets that must be refused.
        wire_faults_hz: rate of damaged, lost and cut servo replies.
        patience_s: longest time in which the arm must work again after a fault.
        seed: seed of all random choices.
    """

    out: Path
    hours: float = 1.0
    rate_hz: float = 20.0
    fault_s: float = 20.0
    bad_share: float = 0.05
    wire_faults_hz: float = 0.5
    patience_s: float = 60.0
    seed: int = 0
    arm: Path = field(default_factory=lambda: folder("config") / "arm_demo.yaml")

    def __post_init__(self) -> None:
        for name, low, high in (
            ("hours", 1e-3, 1000.0),
            ("rate_hz", 0.1, 200.0),
            ("fault_s", 0.5, 1e6),
            ("bad_share", 0.0, 1.0),
            ("wire_faults_hz", 0.0, 20.0),
            ("patience_s", 1.0, 600.0),
        ):
            if not low <= getattr(self, name) <= high:
                raise InputError("soak", name, getattr(self, name), f"{low:g} to {high:g}")

    @property
    def model(self) -> Path:
        """Model file; it is broken and restored during the test."""
        return self.out / "model.yaml"

    @property
    def predictor(self) -> Path:
        """Predictor file; it is broken and restored during the test."""
        return self.out / "predictor.npz"

    def graph(self) -> BringUp:
        """Graph of the simulated arm on /clock, with a low image rate."""
        own: dict[str, dict[str, object]] = {
            "simulated_arm": {
                "frame_rate_hz": 1.0,
                "seed": self.seed,
                "wire_faults_hz": self.wire_faults_hz,
            },
            "kinematics": {"move_time_s": 0.05, "learning": True},
            "servo_driver": {"state": str(self.out.absolute() / "state")},
        }
        return BringUp(
            arm=self.arm,
            model=self.model,
            predictor=self.predictor,
            sim=True,
            namespace=NAMESPACE,
            speed=10.0,
            paths=True,
            set={n: own.get(n, {}) | {"use_sim_time": True} for n in (*SIMULATED, PATHS)},
        )
