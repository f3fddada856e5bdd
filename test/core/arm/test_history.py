"""How joints came to where they stand: legs, what they leave known, run-ups in files."""

import copy
import dataclasses
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from few_effects import names_alone
from small_arm import ARM
from wind_up import Sliders, WindUp, there_and_back

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import LEGS, Context
from longarm_comp.core.arm.history import History, add_way, compute_play_range, recorded_history
from longarm_comp.core.calibration.calibrate import declared_model
from longarm_comp.core.compensation.arrive import compensate_move
from longarm_comp.core.compensation.online import Readings
from longarm_comp.core.compensation.unknown import unknown_history
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import ServoDroop
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis
from longarm_comp.core.effects.slow_changes import ThermalGrowth
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.run_ups import with_fitted_run_ups
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import read_csv, write_csv
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext

SPAN = ARM.upper - ARM.lower


def legs_of(*ways: float) -> list[float]:
    made: list[float] = []
    for way in ways:
        made = add_way(made, way)
    return made


def test_legs_alternate_latest_first_and_swallow_the_loops_they_close() -> None:
    assert legs_of(5, -3, 2, -1) == [-1, 2, -3, 5]
    assert legs_of(5, -3, 1, 1) == [2, -3, 5]  # on in the same direction: one leg
    assert legs_of(5, -3, 2, -2.5) == [-3.5, 5]  # closes the loop of 2 and goes on with the 3
    assert legs_of(5, -3, 2, -2) == [-3, 5]
    assert legs_of(5, -3, 4) == [6]  # both earlier legs are swallowed
    assert legs_of(2, -3) == [-3]  # nothing is left of what came before the larger one
    assert legs_of(0, 2, 0) == [2]


def test_more_nested_legs_than_places_forget_the_oldest() -> None:
    ways = [(-1) ** k * (20.0 - k) for k in range(LEGS + 3)]
    kept = legs_of(*ways)
    assert kept == ways[::-1][: LEGS - 1]
    low, high = compute_play_range(kept, 9.9)
    assert low < high  # 2 R is longer than what is left: no longer known
    assert low <= compute_play_range(ways[::-1], 9.9)[0] <= high


def test_legs_say_what_the_whole_way_says_for_every_radius(rng: np.random.Generator) -> None:
    """Sliders of the simulator, dragged along the whole way, from both ends of what may be."""
    known = 0
    for _ in range(200):
        ways = rng.standard_normal(12) * rng.choice([0.2, 1.0, 3.0], 12)
        for radius in (0.1, 0.5, 2.0, 6.0):
            low, high = compute_play_range(legs_of(*ways), radius)
            truly = []
            for start in (-radius, radius):
                slider = Sliders(np.array([radius]), np.array([[radius]]), np.zeros(1))
                slider.drive(np.array([[start]]))  # wound up to one end, without a way
                slider.drive((start + np.cumsum(ways))[:, None])
                truly.append(slider.behind[0])
            assert min(truly) >= low - 1e-9 and max(truly) <= high + 1e-9
            if len(legs_of(*ways)) < LEGS - 1:
                np.testing.assert_allclose([low, high], truly, atol=1e-9)
            known += bool(low == high)
    assert 300 < known < 800


def test_what_is_not_known_counts_as_its_middle_and_slides_wind_up_in_a_tenth() -> None:
    sticky = FrictionHysteresis(3, far=0.2, width=1e-3, outer=1e-3)

    def shift(*legs: float) -> float:
        held = np.zeros((ARM.n, LEGS))
        held[2, : len(legs)] = legs
        context = Context((1.0,) * ARM.n, legs=tuple(held.ravel().tolist()))
        return float(
            np.linalg.norm(Model(ARM, (sticky,)).tip(ARM.mid, context) - Model(ARM).tip(ARM.mid))
        )

    assert shift() == pytest.approx(0.0, abs=1e-12)  # anything from one side to the other
    assert shift(0.02) == pytest.approx(0.25e-3, rel=1e-6)  # half of the way of 40 mm
    assert shift(0.04) == pytest.approx(0.5e-3, rel=1e-6)


def test_a_doubtful_joint_may_be_wound_up_either_way() -> None:
    model = Model(ARM, (FrictionHysteresis(2, far=0.1, width=0.01, outer=0.01),))
    context = Context(
        **History.unknown(ARM.n).after(there_and_back(ARM, ARM.mid), ARM.mid).fields()
    )
    sure, (why,) = unknown_history(model, ARM.mid[None], context)
    assert np.linalg.norm(sure) == 0.0 and why == ""
    doubtful = np.array([False, True, False, False])
    unsure, (why,) = unknown_history(model, ARM.mid[None], context, doubtful)
    assert "earlier moves" in why
    blank = Context(context.approach)
    whole, _ = unknown_history(model, ARM.mid[None], blank)
    np.testing.assert_allclose(unsure, whole, rtol=1e-9)


def test_a_doubt_is_of_its_own_row_and_its_circumstances() -> None:
    model = Model(ARM, (ThermalGrowth(1e-3), FrictionHysteresis(2, far=0.1, width=0.01)))
    q = np.stack([ARM.mid, ARM.mid + 0.2, ARM.mid - 0.1])
    warm = np.array([20.0, 40.0, 60.0])

    def doubt(rows: slice, warm: np.ndarray) -> np.ndarray:
        return unknown_history(model, q[rows], Context(columns={"temperature_c": warm}))[0]

    together = doubt(slice(None), warm)
    for row in range(3):
        own = slice(row, row + 1)
        np.testing.assert_allclose(together[own], doubt(own, warm[own]), rtol=1e-9, atol=1e-15)
    assert np.abs(doubt(slice(None), warm[::-1]) - together).max() > 1e-3 * together.max()


def test_a_joint_that_was_moved_by_nobody_knows_what_has_no_legs() -> None:
    wound = History.unknown(1).after(np.array([[0.0], [0.5], [0.2]]), None)
    assert wound.legs[0, :2].tolist() == pytest.approx([-0.3, 0.5])
    assert (wound.after(np.array([[0.9]]), None).legs == 0).all()
    after = wound.after(np.array([[0.8], [0.9]]), None).legs
    assert after[0, :2].tolist() == pytest.approx([0.1, 0.0])


def test_a_wound_joint_lags_behind_its_motion() -> None:
    model = Model(ARM, (FrictionHysteresis(1, far=0.1, width=0.01, outer=0.01),))
    home = np.zeros(ARM.n) + ARM.mid

    def turned(*ways: float) -> float:
        """Angle about the vertical axis that the tip is off by."""
        path = home + np.outer(np.cumsum(ways), [1.0, 0.0, 0.0, 0.0])
        history = History.unknown(ARM.n).after(path - path[-1] + home, None)
        x, y, _ = model.tip(home, Context(**history.fields()))
        u, v, _ = Model(ARM).tip(home)
        return float(np.arctan2(y, x) - np.arctan2(v, u))

    assert turned(0.0, 0.3) == pytest.approx(-0.005, rel=1e-6)  # from below: it stops short
    assert turned(0.0, 0.3, -0.3) == pytest.approx(0.005, rel=1e-6)
    assert turned(0.0, 0.3, -0.1) == pytest.approx(0.0, abs=1e-9)
    assert turned(0.0, 0.3, -0.05) == pytest.approx(-0.0025, rel=1e-6)


# ------------------------------------------------------------------ recordings


def test_a_gap_forgets_all_legs_and_a_run_up_is_known_after_it() -> None:
    q = np.array([[0.0], [1.0], [0.2], [0.5]])
    whole = recorded_history(q, np.arange(4)).legs[:, 0, :3]
    np.testing.assert_allclose(whole, [[0, 0, 0], [1, 0, 0], [-0.8, 1, 0], [0.3, -0.8, 1]])
    gap = recorded_history(q, np.array([0, 1, 3, 4]))
    np.testing.assert_allclose(gap.legs[:, 0, :3], [[0, 0, 0], [1, 0, 0], [0, 0, 0], [0.3, 0, 0]])
    assert gap.approach.ravel().tolist() == [0, 1, 0, 1]
    run_up = np.array([[np.nan], [np.nan], [0.5], [np.nan]])
    after = recorded_history(q, np.array([0, 1, 3, 4]), run_up=run_up)
    np.testing.assert_allclose(after.legs[:, 0, :2], [[0, 0], [1, 0], [-0.3, 0], [0.3, 0]])
    assert after.approach.ravel().tolist() == [0, 1, -1, 1]


def test_a_run_up_is_two_legs_and_may_pass_its_target_first() -> None:
    q = np.array([[0.0], [1.0], [2.0]])
    run_up = np.array([[np.nan], [np.nan], [2.3]])
    found = recorded_history(q, np.arange(3), run_up=run_up)
    assert found.approach[2, 0] == -1
    np.testing.assert_allclose(found.legs[2, 0, :3], [-0.3, 2.3, 0.0], atol=1e-12)


def test_the_last_way_is_of_the_last_move_alone_since_the_joint_turned() -> None:
    """Legs run on from move to move; a run-up that the joint only passes is no turn."""
    q = np.array([[0.0], [1.0], [1.6], [1.4], [2.0], [2.0], [2.5], [3.0]])
    run_up = np.array([[np.nan]] * 4 + [[1.5], [np.nan], [2.7], [np.nan]])
    index = np.array([0, 1, 2, 3, 4, 4, 5, 9])
    session = Session.record(q, np.zeros((8, 3)), index=index, run_up=run_up)
    np.testing.assert_allclose(session.legs[2, 0, 0], 1.6)
    ways = [0.0, 1.0, 0.6, -0.2, 0.6, 0.6, -0.2, 0.0]
    np.testing.assert_allclose(session.last_way.ravel(), ways, atol=1e-12)
    np.testing.assert_allclose(session.take(slice(3, 6)).last_way.ravel(), ways[3:6], atol=1e-12)
    assert np.isnan(session.run_up).ravel().tolist() == [True] * 6 + [False, True]


def test_the_last_way_of_a_side_without_a_length_is_that_of_the_length_taken() -> None:
    q = np.array([[0.0], [1.0], [0.4]])
    session = Session.record(q, np.zeros((3, 3)), approach=np.array([np.nan, np.nan, 1.0]))
    assert session.last_way.ravel().tolist() == [0.0, 1.0, 0.0]
    np.testing.assert_allclose(session.with_run_ups(np.array([0.1])).last_way[2], [0.1])


def test_the_last_way_after_a_motion_is_known_where_the_motion_is() -> None:
    came = History.unknown(2).after(np.array([[0.5, 0.5], [0.8, 0.2], [0.8, 0.1]]), None)
    np.testing.assert_allclose(came.last_way, [0.3, -0.4], atol=1e-12)
    assert came.after(np.array([[0.9, 0.3]]), None).last_way.tolist() == [0.0, 0.0]
    assert came.with_sides(np.array([1.0, 0.0])).last_way == pytest.approx([0.0, -0.4])
    other = History(-came.approach, came.legs, came.last_way)
    assert came.common_with(other).last_way.tolist() == [0.0, 0.0]
    assert not came.agrees(History(came.approach, came.legs, came.last_way + 1e-3))


def test_a_side_without_a_length_leaves_the_legs_unknown_until_a_length_is_taken() -> None:
    q = np.array([[0.0], [1.0], [0.4]])
    sides = np.array([np.nan, np.nan, 1.0])
    session = Session.record(q, np.zeros((3, 3)), approach=sides)
    assert session.approach.ravel().tolist() == [0, 1, 1]
    assert (session.legs[2] == 0).all()
    taken = session.with_run_ups(np.array([0.1]))
    np.testing.assert_allclose(taken.legs[2, 0, :3], [0.1, -0.7, 1.0])
    np.testing.assert_array_equal(taken.legs[:2], session.legs[:2])
    assert taken.approach.tolist() == session.approach.tolist()
    assert np.isnan(session.run_up).all() and np.isnan(taken.run_up).all()
    again = taken.with_run_ups(np.array([0.2]))
    np.testing.assert_allclose(again.legs[2, 0, :3], [0.2, -0.8, 1.0])


def driven(n: int, rng: np.random.Generator) -> Session:
    """A session of which some joints ran up, some came straight, and some tell only a side."""
    q = ARM.lower + SPAN * (0.2 + 0.6 * rng.random((n, ARM.n)))
    side = rng.choice([-1.0, 1.0], q.shape)
    begun = np.where(rng.random(q.shape) < 0.6, q - 0.06 * side * SPAN, np.nan)
    told = np.where(np.isnan(begun) & (rng.random(q.shape) < 0.5), side, 0.0)
    index = np.arange(n) + 2 * (np.arange(n) > n // 2)
    return Session.record(q, Model(ARM).tip(q), index=index, approach=told, run_up=begun)


def test_run_ups_are_written_and_read_back(tmp_path: Path, rng: np.random.Generator) -> None:
    session = driven(40, rng)
    write_csv(session, tmp_path / "s.csv")
    back = read_csv(tmp_path / "s.csv", ARM)
    np.testing.assert_allclose(back.legs, session.legs, atol=1e-12)
    np.testing.assert_allclose(back.last_way, session.last_way, atol=1e-12)
    for name in ("approach", "told", "q", "index"):
        np.testing.assert_array_equal(getattr(back, name), getattr(session, name))
    assert (session.told != 0).any() and np.isfinite(session.run_up).any()


def test_a_bag_carries_run_ups_and_sides_without_a_length(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    pytest.importorskip("rosbags")
    from session_bag import write_bag

    from longarm_comp.sessions.bag import read_bag

    session = driven(25, rng)
    write_bag(session, tmp_path / "bag", ARM)
    back = read_bag(tmp_path / "bag", ARM)
    np.testing.assert_allclose(back.legs, session.legs, atol=1e-12)
    np.testing.assert_allclose(back.last_way, session.last_way, atol=1e-12)
    np.testing.assert_array_equal(back.approach, session.approach)
    np.testing.assert_array_equal(back.told, session.told)


def test_a_run_up_on_the_other_side_than_the_approach_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    header = "q1,q2,q3,q4,x,y,z,approach,run_up_q1,run_up_q2,run_up_q3,run_up_q4"
    path.write_text(f"{header}\n0,0.5,0.05,0,1,0,0,1,-0.1,0.4,,0.1\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"run_up_q4.*below q4"):
        read_csv(path, ARM)


# ------------------------------------------------------------------ found


RADII = np.array([1e-3, 0.035, 0.16])
HALF = np.array([[2.0], [1.2], [1.8]]) * 1e-3


def planted(arm: Arm, n: int, rng: np.random.Generator, told: bool) -> tuple[Session, np.ndarray]:
    """A session on the simulated arm, whose turning joints remember with three radii."""
    turning = np.array([arm.joints[row - 1].type == "revolute" for row in arm.commanded])
    sliders = Sliders(RADII, HALF * turning, arm.mid)
    sliders.drive(there_and_back(arm, arm.mid))
    span = arm.upper - arm.lower
    q = arm.lower + span * (0.1 + 0.8 * rng.random((n, arm.n)))
    length = np.where(turning, 0.05, 0.005)
    side = rng.choice([-1.0, 1.0], n)[:, None]
    begun = np.where(rng.random((n, 1)) < 0.7, q - side * length, np.nan)
    behind = np.empty_like(q)
    for i in range(n):
        path = q[i : i + 1] if np.isnan(begun[i]).any() else np.stack([begun[i], q[i]])
        sliders.drive(path)
        behind[i] = sliders.behind
    tip = TrueArm(arm, [WindUp()], steps=2).tip(q, TrueContext(behind=behind))
    seen = tip + 1e-4 * rng.standard_normal(tip.shape)
    if told:
        sides = np.where(np.isnan(begun[:, 0]), 0.0, side[:, 0])
        return Session.record(q, seen, approach=sides), tip
    return Session.record(q, seen, run_up=begun), tip


RIVALS = (FrictionHysteresis, Backlash, ServoDroop, JointGain)


@pytest.mark.parametrize(
    ("told", "kinds"), [pytest.param(False, None, marks=pytest.mark.long), (True, RIVALS)]
)
def test_memory_of_several_radii_is_found_named_and_predicts(
    demo_arm_path: str, told: bool, kinds: tuple[type[Effect], ...] | None, rng: np.random.Generator
) -> None:
    """Among what acts at one joint; in `make long` among all effects, and functions."""
    arm = Arm.load(demo_arm_path)
    session, _ = planted(arm, 220 if kinds is None else 150, rng, told)
    held, _ = planted(arm, 60, np.random.default_rng(98), told)
    with names_alone() if kinds else nullcontext():
        found = diagnose(arm, session, test=held, kinds=kinds)
    assert found.verdict == "named"
    assert [f.name for f in found.findings] == ["friction_hysteresis"]
    terms = [t for t in found.model.effects if isinstance(t, FrictionHysteresis)]
    turning = [row for row in arm.commanded if arm.joints[row - 1].type == "revolute"]
    assert {t.joint for t in terms} == set(turning)
    for term in terms:
        assert term.width == pytest.approx(2 * HALF.sum(), rel=0.08)
        assert term.far == pytest.approx(RADII[2], rel=0.25)
        if told:
            assert term.run_up == pytest.approx(0.05, rel=0.5)
        else:
            assert term.run_up == 0.0
    fresh, tip = planted(arm, 60, np.random.default_rng(99), told=False)
    left = np.linalg.norm(found.model.tip(fresh.q, fresh.context()) - tip, axis=1)[15:]
    assert np.sqrt((left**2).mean()) < 3e-4
    assert commanded(arm, found.model) < 1.5e-4


def commanded(arm: Arm, model: Model) -> float:
    """Mean miss of the simulated tip (m) over 6 commands, the past unknown."""
    turning = np.array([arm.joints[row - 1].type == "revolute" for row in arm.commanded])
    truly, rng = TrueArm(arm, [WindUp()], steps=2), np.random.default_rng(1)
    sliders = Sliders(RADII, HALF * turning, arm.mid)
    past = arm.lower + (arm.upper - arm.lower) * rng.random((8, arm.n))
    sliders.drive(past)
    at, history, misses = past[-1], History.unknown(arm.n), []
    moves = [there_and_back(arm, at)]
    for _ in range(6):
        sliders.drive(moves[-1])
        history, at = history.after(moves[-1], at), moves[-1][-1]
        target = Model(arm).tip(
            arm.lower + (arm.upper - arm.lower) * rng.uniform(0.15, 0.85, arm.n)
        )
        arrival = compensate_move(
            model, None, target, start=at, history=history, position_only=True,
            context_after=partial(Readings().context, model, 1.0, 1.0),
        )  # fmt: skip
        assert "not known" not in arrival.outcome.reason
        moves.append(arrival.move.points)
        after = copy.deepcopy(sliders)
        after.drive(moves[-1])
        tip = truly.tip(arrival.outcome.command, TrueContext(behind=after.behind))
        misses.append(np.linalg.norm(tip - target))
    return float(np.mean(misses))


def test_a_model_keeps_the_run_ups_that_it_was_fitted_with(rng: np.random.Generator) -> None:
    """What it holds is not tried again, so nothing else may take them to be unknown."""
    model = declared_model(ARM).plus(FrictionHysteresis(2, far=0.1, run_up=0.05, width=0.01))
    q = ARM.lower + (ARM.upper - ARM.lower) * (0.1 + 0.8 * rng.random((60, ARM.n)))
    told = Session.record(q, np.zeros((60, 3)), approach=rng.choice([-1.0, 1.0], 60))
    context = with_fitted_run_ups(told, model).context()
    seen = model.tip(q, context) + 1e-4 * rng.standard_normal((60, 3))
    found = diagnose(ARM, dataclasses.replace(told, xyz=seen), model=model, kinds=(JointGain,))
    assert (found.train.legs != 0).any(axis=(1, 2)).all()


def test_along_a_path_every_way_point_has_the_history_of_a_move_there() -> None:
    for seed in range(40):
        rng = np.random.default_rng(seed)
        steps = rng.normal(size=(6, 3)) * rng.choice([0.0, 1e-7, 1e-2, 1.0], (6, 3))
        path, start = np.cumsum(steps, axis=0), rng.normal(size=3)
        history = History.unknown(3).after(rng.normal(size=(1, 3)), start)
        found, at, now = history.along(path, start), start, history
        for row, point in enumerate(path):
            now, at = now.after(point[None], at), point
            np.testing.assert_array_equal(found.approach[row], now.approach)
            np.testing.assert_allclose(found.legs[row], now.legs, atol=1e-5)
            np.testing.assert_array_equal(found.last_way[row], now.last_way)
        unknown = history.along(path, None)
        np.testing.assert_array_equal(unknown.legs[0], 0.0)


def test_of_two_histories_only_joints_of_one_side_are_known() -> None:
    one = History.unknown(2).after(np.array([[0.1, 0.1]]), np.zeros(2))
    other = History.unknown(2).after(np.array([[0.2, -0.2]]), np.zeros(2))
    common = one.common_with(other)
    assert common.approach.tolist() == [1.0, 0.0]
    assert common.legs[:, 0].tolist() == [0.1, 0.0]
    assert common.last_way.tolist() == [0.1, 0.0]
