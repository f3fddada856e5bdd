"""What no parameter explains at poses that return: followed there, and not learned elsewhere."""

import numpy as np
from at_work_arm import Work, fitted
from hidden_arm import SIGMA
from known_arm import calibrated, judged
from read_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.at_work.changes import Parameters
from longarm_comp.core.at_work.learner import Learner
from longarm_comp.core.at_work.posterior import RecursivePosterior
from longarm_comp.core.at_work.row import Row
from longarm_comp.core.compensation.sighting import COMMON, VISITED
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.drives import GearEccentricity
from longarm_comp.sim.hidden.geometry import JointZero

WAVES = ((1.5e-3, 1.5e-3), (1.0, 2.0))
"""Amplitudes and phases of the second and third harmonic of every joint, rad."""


def test_at_poses_that_return_what_the_model_lacks_is_not_learned() -> None:
    """What is alike at each visit tells no more than one visit; 0.78 were inside, 1.13 mm off."""
    amplitude, phase = (np.repeat([[0.0], [a], [b]], ARM.n, axis=1) for a, b in WAVES)
    truth = TrueArm(ARM, [GearEccentricity(amplitude, phase)])
    rng = np.random.default_rng(1)
    job = ARM.lower + rng.random((4, ARM.n)) * (ARM.upper - ARM.lower)
    learner = Learner.of(calibrated(truth, "wide"))
    before = judged(learner.model, truth)
    for k in range(150):
        tip = truth.tip(job[k % 4][None])[0] + SIGMA * rng.standard_normal(3)
        learner = learner.learn(job[k % 4], Context(), tip, np.full(3, SIGMA**2), 60.0 * k)
    inside, error, radius = judged(learner.model, truth)
    assert inside > 0.85 and error < 1.05 * before[1] and radius < 1.05 * before[2]
    assert learner.named == ()
    slipped = TrueArm(ARM, [GearEccentricity(amplitude, phase), JointZero(np.eye(ARM.n)[1] * 5e-3)])
    for k in range(150, 200):
        tip = slipped.tip(job[k % 4][None])[0] + SIGMA * rng.standard_normal(3)
        learner = learner.learn(job[k % 4], Context(), tip, np.full(3, SIGMA**2), 60.0 * k)
    assert [n.where for n in learner.now] == ["joint 2"]
    assert judged(learner.model, slipped)[0] > 0.85


def test_the_own_errors_of_poses_are_as_in_a_whole_regression() -> None:
    """Three poses in turn; then another one in the place of the first, which is forgotten."""
    rng = np.random.default_rng(3)
    space = Parameters.of(fitted(), Work().pose()[1])
    active, own = np.arange(6), 0.3 * np.eye(3)
    root = rng.standard_normal((6, 6))
    begun = RecursivePosterior.begin(space, space.values(space.model), active, root @ root.T)
    each = [0, 1, 2, 0, 1, 2, 0]
    known, met = begun, set[int]()
    whole, data = [], []
    for pose, place in enumerate([*each, 0]):
        row = Row(
            0.0, rng.standard_normal((3, len(space))), rng.standard_normal(3), np.eye(3), 1.0,
            place=place,
        )  # fmt: skip
        if place not in met or pose == len(each):
            known = known.with_anew(known.common + 3 * place, own)
        met.add(place)
        known = known.update(row)
        whole.append(row.columns)
        data.append(row.value - row.columns @ space.values(space.model))
    of_pose = np.eye(4)[[*each, 3]]
    a, y = np.concatenate(whole)[:, active], np.concatenate(data)
    shared = np.kron(of_pose @ of_pose.T, own)
    spread = a @ root @ root.T @ a.T + shared + np.eye(len(y))
    expected = root @ root.T @ a.T @ np.linalg.solve(spread, y)
    got = (known.mean[: len(space)] - space.values(space.model))[active]
    np.testing.assert_allclose(got, expected, atol=1e-8)
    jump = np.concatenate([row_columns[:, 20] for row_columns in whole])
    jump[:6] = 0.0
    expected = root @ root.T @ a.T @ np.linalg.solve(spread, y - jump)
    np.testing.assert_allclose(got - known.response[2, :6, 20], expected, atol=1e-8)


def test_the_last_poses_are_followed() -> None:
    first = Work().learned(Learner.of(fitted()), 1)
    learner = Work().learned(Work().learned(first, VISITED), 1)  # and once more to the first pose
    learner = Work(seed=1).learned(learner, 1)
    assert first.explanations is not None and learner.explanations is not None
    (_, pose), visited = first.explanations.visited[0], learner.explanations.visited
    assert {place for place, _ in visited} == set(range(VISITED))
    assert [place for place, at in visited if (at == pose).all()] == [0]
    each = [b.posterior for b in learner.explanations.branches]
    assert {len(known.mean) - len(known.space) for known in each} == {COMMON + 3 * VISITED}
