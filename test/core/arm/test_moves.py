"""Commands are moves: the side of arrival is chosen, a run-up makes it so, limits hold."""

import csv
import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from read_arm import ARM as HEAVY
from small_arm import ARM, measured

from longarm_comp.core.arm.context import PER_JOINT, Context
from longarm_comp.core.arm.history import SAME_POSE, History
from longarm_comp.core.arm.moves import plan_move, run_up_lengths, wanted_sides
from longarm_comp.core.compensation.arrive import Arrival, compensate_move
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.compensation.result import CompensationOptions, Method
from longarm_comp.core.effects.joint_term import joint_load
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.effects.typical_loads import typical_loads
from longarm_comp.core.model.model import Model
from longarm_comp.workflows.compensate import compensate

SPAN = ARM.upper - ARM.lower
LENGTH = run_up_lengths(ARM)
SHARE = st.lists(st.floats(0.0, 1.0), min_size=ARM.n, max_size=ARM.n)
SIDES = st.lists(st.sampled_from([-1.0, 0.0, 1.0]), min_size=ARM.n, max_size=ARM.n)


def joints(share: list[float]) -> np.ndarray:
    return np.clip(ARM.lower + SPAN * np.array(share), ARM.lower, ARM.upper)


@settings(deadline=None, max_examples=300)
@given(SHARE, SHARE, SIDES, SHARE, st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_every_joint_arrives_from_its_side_or_is_marked(start, goal, wanted, far, before) -> None:
    start, q, wanted = joints(start), joints(goal), np.array(wanted)
    length, leg = np.array(far) * SPAN, np.array(before) * SPAN
    move = plan_move(ARM, start, q, wanted, length=length, leg=leg)
    points = move.points
    assert (points >= ARM.lower).all() and (points <= ARM.upper).all()
    np.testing.assert_array_equal(points[-1], q)
    came = History.unknown(ARM.n).after(points, start)
    np.testing.assert_array_equal(came.approach, move.side)
    asked = (wanted != 0) & ~move.doubtful
    np.testing.assert_array_equal(move.side[asked], wanted[asked])
    last = np.abs(q - (points[-2] if len(points) > 1 else start))
    assert (last[asked] >= LENGTH[asked] * (1 - 1e-9)).all()  # long enough to take up the play
    room = np.where(wanted > 0, q - ARM.lower, ARM.upper - q)
    goes_on = (len(points) == 1) & (leg * (q - start) > 0)
    way = last + np.where(goes_on, np.abs(leg), 0.0)
    needed = np.minimum(np.maximum(length, LENGTH), room)
    once = len(points) == 1  # beside joints that run up, one that needs none goes the last part so
    assert (way[asked] >= needed[asked] * (1 - 1e-9)).all() or not once
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


def test_a_run_up_is_as_long_as_asked_where_there_is_room_or_goes_on_with_the_last_leg() -> None:
    q, up = ARM.mid, np.ones(ARM.n)
    start, long = q - 2 * LENGTH, 4 * LENGTH
    np.testing.assert_allclose(plan_move(ARM, start, q, up, length=long).run_up, q - long)
    near = ARM.lower + 3 * LENGTH
    np.testing.assert_allclose(plan_move(ARM, None, near, up, length=long).run_up, ARM.lower)
    assert plan_move(ARM, start, q, up, length=long, leg=2.1 * LENGTH).run_up is None
    assert plan_move(ARM, start, q, up, length=long, leg=1.9 * LENGTH).run_up is not None
    assert plan_move(ARM, start, q, up, length=long, leg=-2.1 * LENGTH).run_up is not None
    # A step that is too short to leave a deadband is none, however long the leg before it
    assert plan_move(ARM, q - 0.5 * LENGTH, q, up, length=long, leg=long).run_up is not None


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
    low, length = ARM.lower + 2 * LENGTH, 7 * LENGTH  # less than a third of it below
    assert wanted_sides(ARM, low - 0.1, low, both, length=length).tolist() == [-1.0] * ARM.n
    assert wanted_sides(ARM, low - 0.1, low, both, length=5 * LENGTH).tolist() == [1.0] * ARM.n


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
        seed=model.arm.mid, options=options, **more,
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


@pytest.mark.parametrize("share", [0.1, 0.5, 2.0])
def test_a_joint_arrives_against_its_load_so_that_the_threshold_does_not_matter(
    rng: np.random.Generator, share: float
) -> None:
    true = Backlash(4, gate=0.2, width=0.02)
    loose, believed = Model(HEAVY, (true,)), Model(HEAVY, (replace(true, gate=share * 0.2),))
    goals = HEAVY.mid + 0.8 * (HEAVY.upper - HEAVY.lower) * (rng.random((10, 4)) - 0.5)
    loads = joint_load(loose.posture_without_sag(tuple(goals.T), Context()), 4)
    torque = typical_loads(HEAVY).torque
    assert (np.abs(loads) > 0.2 * torque).any() and (np.abs(loads) < 0.2 * torque).any()
    for goal, way in itertools.product(goals, (-0.3, 0.3)):
        target = Model(HEAVY).tip(goal)
        found = arrive(believed, goal + way, target)
        truly = loose.tip(found.outcome.command, Context(tuple(found.move.side)))
        np.testing.assert_allclose(truly, target, rtol=0, atol=1e-5)


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
    outcome = found.outcome
    sure = expected_miss(loose, outcome.command, found.context, target)
    more = (outcome.sigma**2).sum() - np.trace(sure.covariance)
    assert np.sqrt(more) == pytest.approx(0.01 * lever, rel=0.05)


def test_an_unknown_start_is_no_obstacle(loose: Model) -> None:
    target = Model(ARM).tip(ARM.mid)
    found = arrive(loose, None, target)
    assert found.outcome.reason == ""
    assert found.move.run_up is not None
    truly = loose.tip(found.outcome.command, Context(tuple(found.move.side)))
    np.testing.assert_allclose(truly, target, rtol=0, atol=1e-6)


# ------------------------------------------------------------------ targets of a file


def test_targets_of_a_file_follow_one_another_after_a_session(
    loose: Model, tmp_path: Path, rng: np.random.Generator
) -> None:
    session = measured(30, rng)
    goals = ARM.mid + 0.3 * SPAN * (rng.random((12, ARM.n)) - 0.5)
    made = compensate(loose, Model(ARM).tip(goals), history=session)
    at, side = session.q[-1], session.approach[-1].astype(float)
    came = History(**{name: getattr(session, name)[-1] for name in PER_JOINT})
    for arrival in made.arrivals:
        assert arrival.outcome.reason == ""
        came = came.after(arrival.move.points, at)
        for name in PER_JOINT:
            np.testing.assert_array_equal(getattr(arrival.history, name), getattr(came, name))
        for point in arrival.move.points:
            side = np.where(np.abs(point - at) > SAME_POSE, np.sign(point - at), side)
            at = point
        truly = loose.tip(arrival.outcome.command, Context(tuple(side)))
        np.testing.assert_allclose(truly, arrival.outcome.target, rtol=0, atol=1e-6)
    path = tmp_path / "commands.csv"
    made.save(path)
    with path.open() as file:
        rows = list(csv.DictReader(file))
    for row, arrival in zip(rows, made.arrivals, strict=True):
        for j in range(ARM.n):
            assert float(row[f"approach_q{j + 1}"]) == arrival.move.side[j]
            assert float(row[f"ideal_q{j + 1}"]) == pytest.approx(arrival.outcome.ideal[j])
            via = row[f"run_up_q{j + 1}"]
            if arrival.move.run_up is None:
                assert via == ""
            else:
                assert float(via) == pytest.approx(arrival.move.run_up[j])
    assert any(row["run_up_q1"] for row in rows)


def test_without_a_history_each_target_has_its_own_run_up(loose: Model) -> None:
    made = compensate(loose, Model(ARM).tip(np.stack([ARM.mid, ARM.mid + 0.01 * SPAN])))
    for arrival in made.arrivals:
        assert arrival.move.run_up is not None and arrival.outcome.reason == ""
        truly = loose.tip(arrival.outcome.command, Context(tuple(arrival.move.side)))
        np.testing.assert_allclose(truly, arrival.outcome.target, rtol=0, atol=1e-6)
    direct = compensate(loose, Model(ARM).tip(ARM.mid), run_up=False)
    assert direct.arrivals[0].move.run_up is None
    assert "depends on circumstances that are not known" in direct[0].reason


def test_a_side_that_a_target_asks_for_is_kept(loose: Model) -> None:
    target = Model(ARM).tip(ARM.mid)
    for side in (-1.0, 1.0):
        made = compensate(loose, target, context=Context((side,) * ARM.n))
        assert made.arrivals[0].move.side.tolist() == [side] * ARM.n
        truly = loose.tip(made[0].command, Context((side,) * ARM.n))
        np.testing.assert_allclose(truly, target, rtol=0, atol=1e-6)
        stiff = compensate(Model(ARM), target, context=Context((side,) * ARM.n))
        assert stiff.arrivals[0].move.side.tolist() == [side] * ARM.n
