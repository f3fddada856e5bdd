"""Arms of mujoco_arm.py drawn at random, without a graph: true errors, promises, false names.

python examples/mujoco_draws.py --arms 20

Every second arm is pulled by a hose, which no library of effects has. Each is measured at poses of
a plan, diagnosed, and sent to 40 fresh targets. In brackets stand names that an arm has not, though
its diagnosis is sure of them (95 % and more).
"""

from __future__ import annotations

import argparse

import numpy as np
from mujoco_arm import NOISE_M, RealArm
from mujoco_walk import HERE

import longarm_comp as la

HAS = {"joint_compliance", "servo_droop", "link_stiffness", "link_mass", "tip_payload"}
SURE, TARGETS, SIGHTINGS = 0.95, 40, 3


def main(arms: int, poses: int) -> None:
    """Print a line for each arm, then how many commands kept their promise, and false names."""
    arm = la.Arm.load(HERE / "mujoco_arm.yaml")
    sums = {"alone": np.zeros(4, int), "hose": np.zeros(4, int)}
    print("arm        declared mm  diagnosed mm  largest  its p90  inside  verdict  names")
    for seed in range(1, arms + 1):
        kind = "alone" if seed % 2 else "hose"
        real, rng = RealArm(seed, kind == "hose"), np.random.default_rng([seed, 3])
        session = measured(real, la.plan(arm, poses, seed=seed).q, rng)
        found = la.diagnose(arm, session, network=False)
        targets = la.declared_model(arm).tip(la.plan(arm, TARGETS, seed=100 + seed).q)
        before, _ = reached(real, targets, la.declared_model(arm))
        error, p90 = reached(real, targets, found.model)
        kept = int((error <= p90).sum())
        chances = ((one.probability, *chance) for one in found.findings for chance in one.chances)
        sure = {name for there, name, chance in chances if there * chance >= SURE}
        wrong = sorted(sure - HAS)
        sums[kind] += (1, kept, len(error), len(wrong))
        names = " ".join([*sorted(sure & HAS), *(f"[{name}]" for name in wrong)])
        print(
            f"{seed:<3d} {kind:<6}{before.mean():12.2f}{error.mean():14.2f}{error.max():9.2f}"
            f"{p90.mean():9.2f}{kept:5d}/{len(error)}  {found.verdict:<7}  {names}",
            flush=True,
        )
    for kind, (count, kept, sent, wrong) in sums.items():
        print(f"{kind}: {count} arms, {kept} of {sent} inside their promise, {wrong} false names")


def measured(real: RealArm, q: np.ndarray, rng: np.random.Generator) -> la.Session:
    """A session at joints (N, 5), rad: their readings, and the mean of some sightings."""
    tips, readings = [], []
    for pose in q:
        tips.append(rest(real, pose))
        readings.append(real.joints)
    seen = np.array(tips) + rng.normal(0.0, NOISE_M / np.sqrt(SIGHTINGS), (len(tips), 3))
    told = {f"read_q{j + 1}": column[:, None] for j, column in enumerate(np.array(readings).T)}
    return la.Session.record(q, seen, readings=told)


def rest(real: RealArm, q: np.ndarray) -> np.ndarray:
    """(3,) m, where the tip rests at commanded joints (5,), rad."""
    for _ in real.move([q]):
        pass
    return real.tip


def reached(real: RealArm, targets: np.ndarray, model: la.Model) -> np.ndarray:
    """True errors and promised 90 % radii (2, M), mm, at the targets (N, 3), m, in its reach."""
    answers = zip(la.compensate(model, targets), targets, strict=True)
    sent = [(one, target) for one, target in answers if one.success]
    error = [np.linalg.norm(rest(real, one.command) - target) for one, target in sent]
    return 1e3 * np.array([error, [one.p90_m for one, _ in sent]])


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--arms", type=int, default=20)
    parser.add_argument("--poses", type=int, default=100)
    main(**vars(parser.parse_args()))
