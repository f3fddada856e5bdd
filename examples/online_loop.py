"""An online loop without ROS: compensate, move, look, watch for drift, calibrate again.

Half-way through, something on the simulated arm slips. The monitor is told the error that each
target leaves, and says so when it is not the one that the calibration promised.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import longarm_comp as la
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.plant import hidden_effects

ARM = Path(__file__).parents[1] / "config" / "arm_demo.yaml"
TARGETS, SLIPS_AT = 80, 40


def main() -> None:
    """Run the loop and show the errors of its three phases."""
    arm = la.Arm.load(ARM)
    rng = np.random.default_rng(3)
    hidden = hidden_effects(arm, {"joint_zero": 5.0}, rng)
    real = TrueArm(arm, hidden)

    def look(q: np.ndarray) -> np.ndarray:
        """Measured tips (N, 3) at commanded joints (N, n)."""
        tips = real.tip(q)
        return tips + rng.normal(0.0, 3e-4, tips.shape)

    def calibrate() -> tuple[la.Model, np.ndarray]:
        """A model of the arm as it is now, and the noise of a sighting (3,), m."""
        poses = la.plan(arm, 80, seed=int(rng.integers(1000))).q
        made = la.calibrate(arm, la.Session.record(poses, look(poses)))
        return made.model, made.fit.sigma

    model, sigma = calibrate()
    monitor, q, phase = la.Monitor(), arm.mid, "calibrated"
    errors: dict[str, list[float]] = {}
    for k, target in enumerate(la.Model(arm).tip(la.plan(arm, TARGETS, seed=1).q)):
        if k == SLIPS_AT:
            hidden += hidden_effects(arm, {"base_pose": 0.8}, rng)
            real = TrueArm(arm, hidden)
            phase = "slipped"
        answer = la.compensate(model, target, seed=q)[0]
        if not answer.success:
            print(f"target {k}: {answer.status.name.lower()}: {answer.reason}")
            continue
        q = answer.command
        error = look(q[None])[0] - target
        errors.setdefault(phase, []).append(1e3 * float(np.linalg.norm(error)))
        monitor = monitor.seen(error, sigma)
        verdict = monitor.verdict()
        if verdict.drifted:
            print(f"target {k}: {verdict.finding}; calibrating again")
            model, sigma = calibrate()
            monitor, phase = la.Monitor(), "calibrated again"

    print("\nphase              targets   mean error")
    for name, values in errors.items():
        print(f"{name:<18} {len(values):7d} {np.mean(values):9.2f} mm")


if __name__ == "__main__":
    main()
