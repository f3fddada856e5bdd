"""A first calibration: from measured poses to a model, and how far it can be trusted.

The arm is declared in config/arm_demo.yaml. The real one is simulated: its joint zeros, lengths and
base differ from the drawing by some millimetres at the tip, and a stereo camera measures it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import longarm_comp as la
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.plant import hidden_effects

ARM = Path(__file__).parents[1] / "config" / "arm_demo.yaml"


def main() -> None:
    """Measure 120 poses, calibrate, compare with the truth that only a simulation knows."""
    arm = la.Arm.load(ARM)
    rng = np.random.default_rng(2)
    sizes = {"joint_zero": 6.0, "dh_error": 3.0, "base_pose": 4.0}  # mm rms at the tip
    real = TrueArm(arm, hidden_effects(arm, sizes, rng))
    poses = la.plan(arm, 120).q
    measured = real.tip(poses) + rng.normal(0.0, 3e-4, (len(poses), 3))  # m
    measured[rng.random(len(poses)) < 0.03] = np.nan  # the marker is lost
    session = la.Session.record(poses, measured)
    calibrated = la.calibrate(arm, session)

    print(f"{len(session)} rows, the marker was seen in {session.seen.sum()}\n")
    print("Held-out errors")
    for name, errors in calibrated.held_out.items():
        print(f"  {name:<12} mean {1e3 * errors.mean:6.2f} mm   max {1e3 * errors.max:6.2f} mm")
    print(f"\nNoise of a sighting: {np.round(1e3 * calibrated.fit.sigma, 2)} mm")
    fresh = la.plan(arm, 100, seed=1).q
    off = 1e3 * np.linalg.norm(calibrated.model.tip(fresh) - real.tip(fresh), axis=1)
    print(f"Model and real arm differ at 100 fresh poses by {off.mean():.2f} mm in the mean")


if __name__ == "__main__":
    main()
