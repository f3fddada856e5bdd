"""Sessions of a simulated arm that has the fault of custom_effect.py.

python examples/custom_effect_session.py build/cable

Writes arm.yaml, samples.csv (150 poses) and test.csv (40 poses). The simulation shares no physics
with the model: it turns the true joint, and integrates rods that bend (docs/simulated_arm.md).
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.sessions.csv import write_csv
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State
from longarm_comp.sim.hidden.base import HiddenEffect

ARM = Path(__file__).parents[1] / "config" / "arm_demo.yaml"
PULLED, DRIVER, GAIN = 4, 1, 0.03  # joints counted from 0: row 5 by row 2
NOISE_M = 2e-4


@dataclass(frozen=True)
class CablePull(HiddenEffect):
    """The true arm: joint PULLED stands GAIN times the driver's angle off."""

    name: ClassVar[str] = "cable_pull"
    doses: ClassVar[tuple[str, ...]] = ("gain",)

    gain: float = GAIN

    def joints(self, q: np.ndarray, state: State) -> np.ndarray:
        """True joint values, (N, n)."""
        true = q.copy()
        true[:, PULLED] += self.gain * state.q[:, DRIVER]
        return true


def session(arm: Arm, poses: int, seed: int) -> Session:
    """Random poses of the true arm, its tip seen with `NOISE_M` on each axis."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(arm.lower, arm.upper, (poses, arm.n))
    seen = TrueArm(arm, [CablePull()]).tip(q) + NOISE_M * rng.standard_normal((poses, 3))
    return Session.record(q, seen)


def main(folder: Path) -> None:
    """Write the three files."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(ARM, folder / "arm.yaml")
    arm = Arm.load(ARM)
    write_csv(session(arm, 150, seed=1), folder / "samples.csv")
    write_csv(session(arm, 40, seed=2), folder / "test.csv")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
