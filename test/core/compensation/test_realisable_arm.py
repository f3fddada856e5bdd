"""Realisable joints of the demonstration's deflected arm, by its own model."""

from __future__ import annotations

import dataclasses
import itertools
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.realisable import Lattice, Search
from longarm_comp.core.effects.masses import TipPayload
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.engines import posture_at, tip_poses
from longarm_comp.core.ik.kernel import characteristic_length
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model, unstack
from studies.many import choose_arrays

SLIDE = 1e-4
LENGTH = 0.3
PRICE = math.degrees(1e-4)


@pytest.fixture(scope="module")
def model(stepped: Arm) -> Model:
    return declared_model(stepped).commandable


def commanded(
    model: Model,
    q: np.ndarray,
    *,
    pose: bool = False,
    offset: Any = 0.0,
    locked: tuple[int, ...] = (),
    price: float = PRICE,
) -> tuple[SimpleNamespace, np.ndarray]:
    """Choices for the tips at joints (N, n), found from elsewhere; and the targets."""
    targets = model.pose(q) if pose else model.tip(q)
    seed = np.tile(model.arm.mid, (len(q), 1))
    seed[:, list(locked)] = q[:, list(locked)]
    found = ik.solve_many(model, targets, seed=seed, locked=locked)
    targets, ideal = targets[found.ok], found.q[found.ok]
    assert len(ideal) > 0.9 * len(q)
    length = LENGTH if pose else characteristic_length(model)
    search = Search(length, price_m=price)
    lattice = Lattice.of(model.arm, offset)
    predict = lambda q: tip_poses(model, q)  # noqa: E731
    return choose_arrays(
        model.arm, lattice, predict, targets, ideal, search, locked=locked
    ), targets


def on_steps(model: Model, q: np.ndarray, offset: Any = 0.0) -> np.ndarray:
    """How far joints are from a step, in steps."""
    k = (q - offset) / model.arm.steps
    made: np.ndarray = np.abs(k - np.rint(k))
    return made


def test_positions_of_the_demonstration_arm(model: Model, rng: np.random.Generator) -> None:
    arm = model.arm
    offset = rng.uniform(-0.5, 0.5, arm.n) * arm.steps
    got, targets = commanded(model, rng.uniform(arm.lower, arm.upper, (20, arm.n)), offset=offset)
    assert on_steps(model, got.joints, offset).max() < 1e-6
    assert (got.joints >= arm.lower).all() and (got.joints <= arm.upper).all()
    # by the model's own code
    errors = [np.linalg.norm(model.tip(q) - targets, axis=1) for q in (got.rounded, got.joints)]
    np.testing.assert_allclose(got.rounded_error[:, 0], errors[0], atol=1e-9)
    np.testing.assert_allclose(got.error[:, 0], errors[1], atol=1e-9)
    assert (errors[1] <= errors[0]).all()
    assert errors[0].mean() > 2e-3
    assert errors[1].mean() < 0.12e-3
    assert (np.abs(got.ideal_error) < 1e-8).all()
    turned = np.degrees(np.abs(got.joints - got.ideal)[:, [0, 1, 3, 4, 5]]).max(axis=1)
    assert 0.3 < turned.mean() < 1.2


def test_poses_weigh_angle_against_position(model: Model, rng: np.random.Generator) -> None:
    arm = model.arm
    q = rng.uniform(arm.lower, arm.upper, (20, arm.n))
    got, targets = commanded(model, q, pose=True)
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


def test_few_steps_by_the_arms_own_model(model: Model, rng: np.random.Generator) -> None:
    """Limits two steps around a pose, so that every combination can be tried on the model."""
    arm = model.arm
    for pose in (False, True):
        middle = rng.uniform(arm.lower + 0.02, arm.upper - 0.02)
        low, high = middle - 1.6 * arm.steps, middle + 1.6 * arm.steps
        data = arm.model_dump(mode="json", exclude_defaults=True)
        for joint, ends in zip(data["joints"], np.stack([low, high], 1).tolist(), strict=True):
            slide = joint["type"] == "prismatic"
            joint["limits_m" if slide else "limits_deg"] = ends if slide else np.degrees(ends)
        small = Arm.parse(data, "small")
        q = rng.uniform(low, high, (5, arm.n))
        targets = model.pose(q) if pose else model.tip(q)
        search = Search(LENGTH, max_nodes=100_000)
        got = choose_arrays(
            small, Lattice.of(arm), lambda q: model.pose(q), targets, q, search
        )  # fmt: skip
        steps = [
            np.arange(math.ceil(a / s), math.floor(b / s) + 1) * s
            for a, b, s in zip(low, high, arm.steps, strict=True)
        ]
        grid = np.array(list(itertools.product(*steps)), float)
        assert len(grid) >= 3**7
        at = model.pose(grid)
        price = PRICE / np.where(arm.steps == SLIDE, LENGTH, 1.0)
        for i, target in enumerate(targets):
            place = target[:3, 3] if pose else target
            cost = ((at[:, :3, 3] - place) ** 2).sum(axis=1)
            cost += ((price * (grid - q[i])) ** 2).sum(axis=1)
            if pose:
                turn = at[:, :3, :3] @ target[:3, :3].T
                angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
                cost += (LENGTH * angle) ** 2
            np.testing.assert_allclose(got.joints[i], grid[np.argmin(cost)], atol=1e-9)


def test_locked_joints_and_limits_of_the_demonstration_arm(
    model: Model, rng: np.random.Generator
) -> None:
    arm = model.arm
    q = rng.uniform(arm.lower, arm.upper, (12, arm.n))
    got, _ = commanded(model, q, locked=(2, 6))
    np.testing.assert_array_equal(got.joints[:, [2, 6]], got.ideal[:, [2, 6]])
    assert (got.error[:, 0] <= got.rounded_error[:, 0]).all()
    assert got.error[:, 0].mean() < 0.25 * got.rounded_error[:, 0].mean()
    for joint in (2, arm.n - 1):  # two joints on their limits
        q[:, joint] = np.where(rng.random(12) < 0.5, arm.lower[joint], arm.upper[joint])
        q[:, (joint + 1) % arm.n] = arm.lower[(joint + 1) % arm.n]
        lattice = Lattice.of(arm, 0.4 * arm.steps)
        edge = choose_arrays(arm, lattice, lambda q: model.tip(q), model.tip(q), q, Search(LENGTH))
        assert (edge.joints >= arm.lower).all() and (edge.joints <= arm.upper).all()
        assert on_steps(model, edge.joints, 0.4 * arm.steps).max() < 1e-6
        assert (edge.error[:, 0] <= edge.rounded_error[:, 0]).all()
        assert np.median(edge.error[:, 0]) < 0.1 * np.median(edge.rounded_error[:, 0])
        q = rng.uniform(arm.lower, arm.upper, (12, arm.n))


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
