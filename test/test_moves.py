"""Commands are moves: the side of arrival is chosen, a run-up makes it so, limits hold."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import SAME_POSE, History
from longarm_comp.core.arm.moves import plan_move, run_up_lengths, wanted_sides
from longarm_comp.core.compensation.arrive import Arrival, CompensationOptions, compensate_move
from longarm_comp.core.compensation.compensate import Method
from longarm_comp.core.effects.backlash import Backlash
from longarm_comp.core.model.model import Model

SPAN = ARM.upper - ARM.lower
LENGTH = run_up_lengths(ARM)
SHARE = st.lists(st.floats(0.0, 1.0), min_size=ARM.n, max_size=ARM.n)
SIDES = st.lists(st.sampled_from([-1.0, 0.0, 1.0]), min_size=ARM.n, max_size=ARM.n)


def joints(share: list[float]) -> np.ndarray:
    return ARM.lower + SPAN * np.array(share)


@settings(deadline=None, max_examples=300)
@given(SHARE, SHARE, SIDES)
def test_every_joint_arrives_from_its_side_or_is_marked(start, goal, wanted) -> None:
    start, q, wanted = joints(start), joints(goal), np.array(wanted)
    move = plan_move(ARM, start, q, wanted)
    points = move.points
    assert (points >= ARM.lower - 1e-12).all() and (points <= ARM.upper + 1e-12).all()
    np.testing.assert_array_equal(points[-1], q)
    came = History.unknown(ARM.n).after(points, start)
    np.testing.assert_array_equal(came.approach, move.side)
    asked = (wanted != 0) & ~move.doubtful
    np.testing.assert_array_equal(move.side[asked], wanted[asked])
    last = np.abs(q - (points[-2] if len(points) > 1 else start))
    assert (last[asked] >= LENGTH[asked] * (1 - 1e-9)).all()  # long enough to take up the play
    via = q - wanted * LENGTH
    np.testing.assert_array_equal(
        move.doubtful & ((via >= ARM.lower) & (via <= ARM.upper)), np.zeros(ARM.n, bool)
    )
    free = wanted == 0
    moved = np.where(np.abs(q - start) < SAME_POSE, 0.0, np.sign(q - start))
    np.testing.assert_array_equal(move.side[free], moved[free])  # its own side, also beside others


def test_a_move_that_comes_from_its_side_already_needs_no_run_up() -> None:
    q = ARM.mid
    start = q - 2 * LENGTH
    assert plan_move(ARM, start, q, np.ones(ARM.n)).run_up is None
    short = plan_move(ARM, q - 0.5 * LENGTH, q, np.ones(ARM.n))
    np.testing.assert_allclose(short.run_up, q - LENGTH)
    other = plan_move(ARM, start, q, -np.ones(ARM.n))
    np.testing.assert_allclose(other.run_up, q + LENGTH)


def test_from_nowhere_every_wanted_side_needs_its_run_up() -> None:
    wanted = np.array([1.0, 0.0, -1.0, 0.0])
    move = plan_move(ARM, None, ARM.mid, wanted)
    np.testing.assert_allclose(move.run_up, ARM.mid - wanted * LENGTH)
    np.testing.assert_array_equal(move.side, wanted)


def test_the_side_is_the_one_that_is_known_has_room_and_is_near() -> None:
    q, both = ARM.mid, np.ones((ARM.n, 2))
    assert wanted_sides(ARM, q - 0.1 * SPAN, q, both).tolist() == [1.0] * ARM.n
    assert wanted_sides(ARM, q + 0.1 * SPAN, q, both).tolist() == [-1.0] * ARM.n
    from_above = both * [10.0, 1.0]
    assert wanted_sides(ARM, q - 0.1 * SPAN, q, from_above).tolist() == [-1.0] * ARM.n
    low, high = ARM.lower + 0.5 * LENGTH, ARM.upper - 0.5 * LENGTH
    assert wanted_sides(ARM, low - 0.1, low, both).tolist() == [-1.0] * ARM.n  # no room below
    assert wanted_sides(ARM, high + 0.1, high, both).tolist() == [1.0] * ARM.n
    never = both * [0.0, 1.0]
    assert wanted_sides(ARM, q + 0.1 * SPAN, q, never).tolist() == [1.0] * ARM.n


@pytest.fixture
def loose() -> Model:
    """Play in two joints, which friction holds where the motion left it."""
    first, second = ARM.commanded[:2]
    return Model(
        ARM, (Backlash(first, gate=0.3, width=0.02), Backlash(second, gate=0.3, width=0.01))
    )


def arrive(model: Model, start: np.ndarray | None, target: np.ndarray, **more: Any) -> Arrival:
    def context(history: History) -> Context:
        return Context(**history.fields())

    options = CompensationOptions(Method.DEFLECTION, run_up=more.pop("run_up", True))
    return compensate_move(
        model, None, target, start=start, history=History.unknown(ARM.n), context_after=context,
        seed=ARM.mid, options=options, **more,
    )  # fmt: skip


def test_a_short_move_lands_where_the_arm_goes(loose: Model, rng: np.random.Generator) -> None:
    for _ in range(20):
        start = ARM.mid + 0.4 * SPAN * (rng.random(ARM.n) - 0.5)
        target = Model(ARM).tip(start + 1e-3 * SPAN * rng.standard_normal(ARM.n))
        found = arrive(loose, start, target)
        assert found.outcome.success and found.outcome.reason == ""
        points = np.vstack([start, found.move.points])
        side = np.zeros(ARM.n)
        for step in np.diff(points, axis=0):
            side = np.where(np.abs(step) > SAME_POSE, np.sign(step), side)
        truly = loose.tip(found.outcome.command, Context(tuple(side)))
        np.testing.assert_allclose(truly, target, rtol=0, atol=1e-6)
        run_up = found.move.points[0] - found.outcome.command
        for j in (0, 1):
            assert abs(run_up[j]) >= LENGTH[j] * 0.999
        for j in (2, 3):  # joints without play do not turn round for it
            assert found.move.side[j] * (found.outcome.command - start)[j] >= 0


def test_switched_off_the_side_follows_from_the_move(loose: Model) -> None:
    start = ARM.mid - 0.01 * SPAN
    found = arrive(loose, start, Model(ARM).tip(ARM.mid), run_up=False)
    assert found.move.run_up is None
    step = found.outcome.command - start
    np.testing.assert_array_equal(found.move.side, np.sign(step))


def test_a_side_that_is_asked_for_without_room_is_doubted_in_millimetres(loose: Model) -> None:
    low = ARM.mid.copy()
    low[0] = ARM.lower[0] + 0.3 * LENGTH[0]
    target = Model(ARM).tip(low)
    found = arrive(loose, low + np.array([1e-3, 0.2, 0.0, 0.0]), target, sides=np.ones(ARM.n))
    assert found.move.doubtful[0] and not found.move.doubtful[1]
    assert f"approach of {ARM.joint_names[0]}" in found.outcome.reason
    assert f"approach of {ARM.joint_names[1]}" not in found.outcome.reason
    lever = np.linalg.norm(target[:2])  # of the first joint, which turns about z
    assert np.linalg.norm(found.outcome.sigma) == pytest.approx(0.01 * lever, rel=0.05)


def test_an_unknown_start_is_no_obstacle(loose: Model) -> None:
    target = Model(ARM).tip(ARM.mid)
    found = arrive(loose, None, target)
    assert found.outcome.reason == ""
    assert found.move.run_up is not None
    truly = loose.tip(found.outcome.command, Context(tuple(found.move.side)))
    np.testing.assert_allclose(truly, target, rtol=0, atol=1e-6)
