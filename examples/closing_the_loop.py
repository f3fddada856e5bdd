"""Closing the loop: find the effects that the model lacks, train a network, reach fresh targets.

The joints of the simulated arm turn some per cent too far or too little, and a cable drags at one
of them. The library has an effect for the first error, so the diagnosis names it. It has none for
the cable; the diagnosis finds it as a function without a name. The network learns the residual.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import longarm_comp as la
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.plant import hidden_effects

ARM = Path(__file__).parents[1] / "config" / "arm_demo.yaml"


def main() -> None:
    """Measure, diagnose, train, compensate, and compare the true tip with the targets."""
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
