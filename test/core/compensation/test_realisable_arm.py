"""Realisable joints for poses of the demonstration's deflected arm; its model in machine code."""

import dataclasses

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.realisable import Lattice, Search
from longarm_comp.core.effects.masses import TipPayload
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.engines import posture_at, tip_poses
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model, unstack
from studies.many import choose_arrays

LENGTH = 0.3


@pytest.fixture(scope="module")
def model(stepped: Arm) -> Model:
    return declared_model(stepped).commandable


def test_poses_weigh_angle_against_position(model: Model, rng: np.random.Generator) -> None:
    arm = model.arm
    q = rng.uniform(arm.lower, arm.upper, (20, arm.n))
    found = ik.solve_many(model, model.pose(q))
    targets, ideal = model.pose(q)[found.ok], found.q[found.ok]
    assert len(ideal) > 0.9 * len(q)
    search, steps = Search(LENGTH), Lattice.of(arm)
    got = choose_arrays(arm, steps, lambda q: tip_poses(model, q), targets, ideal, search)
    made = model.pose(got.joints)
    turn = made[:, :3, :3] @ targets[:, :3, :3].swapaxes(1, 2)
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    np.testing.assert_allclose(got.error[:, 1], angle, atol=1e-7)
    distance = np.linalg.norm(made[:, :3, 3] - targets[:, :3, 3], axis=1)
    np.testing.assert_allclose(got.error[:, 0], distance, atol=1e-9)
    weighted = [np.hypot(e[:, 0], LENGTH * e[:, 1]) for e in (got.rounded_error, got.error)]
    assert (weighted[1] <= weighted[0] + 1e-12).all()
    assert got.error[:, 0].mean() < 1e-3 < 2e-3 < got.rounded_error[:, 0].mean()
    assert got.error[:, 1].mean() < got.rounded_error[:, 1].mean()


@pytest.mark.parametrize("compiled", [True, False])
def test_tip_poses_and_postures_are_the_models(
    compiled: bool, model: Model, rng: np.random.Generator
) -> None:
    fresh = dataclasses.replace(model, effects=(*model.effects, TipPayload(mass=0.05 + compiled)))
    q = rng.uniform(fresh.arm.lower, fresh.arm.upper, (21, fresh.arm.n))
    context = Context(columns={"payload_kg": rng.uniform(0, 1, 21)})
    if compiled:
        assert ik.solve_many(fresh, fresh.tip(q, context), context=context,
                             engine=ik.Engine.COMPILED).ok.any()  # fmt: skip
    np.testing.assert_allclose(tip_poses(fresh, q, context), fresh.pose(q, context), atol=1e-12)
    for rows in (slice(None), 7):
        at = posture_at(fresh, q[rows], context.take(rows))
        own = fresh.posture(unstack(q[rows]), context.take(rows))
        for frame, expected in zip(at.frames, own.frames, strict=True):
            np.testing.assert_allclose(frame.matrix(), expected.matrix(), atol=1e-12)
        np.testing.assert_allclose(at.moment(2), own.moment(2), rtol=1e-9, atol=1e-12)
    labelled = Context(labels={"group": np.array(["a", "b"] * 10 + ["a"])})
    np.testing.assert_array_equal(tip_poses(model, q, labelled), model.pose(q, labelled))
    assert len(posture_at(model, q, labelled).frames[-1].p[0]) == 21
