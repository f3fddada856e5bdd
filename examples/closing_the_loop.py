"""Closing the loop: find what the model lacks, train on the rest, reach fresh targets.

The joints of the simulated arm turn some per cent too far or too little, and a cable drags at one
of them. The first is in the library of effects, so that the diagnosis can name it; the second is
not, and is found as a function of the posture. The network learns what is left.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import longarm_comp as la
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.plant import hidden_effects

ARM = Path(__file__).parents[1] / "config" / "arm_demo.yaml"


def main() -> None:
    """Measure, diagnose, train, compensate, and look where the tip really goes."""
    arm = la.Arm.load(ARM)
    rng = np.random.default_rng(2)
    real = TrueArm(arm, hidden_effects(arm, {"joint_gain": 8.0, "cable_drag": 2.0}, rng))
    poses = la.plan(arm, 200).q
    seen = real.tip(poses) + rng.normal(0.0, 3e-4, (len(poses), 3))  # m
    session = la.Session.record(poses, seen)

    calibrated = la.calibrate(arm, session)
    found = la.diagnose(arm, session, network=False)
    predictor = la.train(arm, session, model=found.model)
    print(f"{found.verdict}: {[finding.name for finding in found.findings]}")
    print(f"network: {predictor.summary}\n")

    targets = la.Model(arm).tip(la.plan(arm, 40, seed=2).q)
    commands = {
        "rigid arm": la.compensate(la.Model(arm), targets),
        "calibrated": la.compensate(calibrated.model, targets),
        "with the effect": la.compensate(found.model, targets),
        "and the network": la.compensate(found.model, targets, predictor),
    }
    print("Distance of the real tip from 40 fresh targets")
    for name, sent in commands.items():
        missed = 1e3 * np.linalg.norm(real.tip(sent.command) - targets, axis=1)
        print(f"  {name:<16} mean {missed.mean():6.2f} mm   max {missed.max():6.2f} mm")
    print(f"\nlast row: {sent.summary}")


if __name__ == "__main__":
    main()
