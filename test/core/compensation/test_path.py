"""Planned paths, compensated: the tip follows, joints do not jump, limits hold."""

import csv
from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell
from places import DEMO_ARM as ARM
from scipy.spatial.transform import Rotation
from small_arm import ARM as SMALL

import longarm_comp as la
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.path import CompensatedPath, PathRefused, compensate_path
from longarm_comp.core.compensation.planned_path import (
    MotionLimits,
    PathLimits,
    PlannedPath,
    find_fastest_way,
    retime,
)
from longarm_comp.core.compensation.result import (
    CompensationOptions,
    Method,
    Prediction,
    Status,
)
from longarm_comp.core.effects.geometry_errors import DhError
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.math.cubic_path import CubicPath, monotone_slopes, smooth_slopes
from studies.path import lagging

SECONDS = 4.0


@pytest.fixture(scope="module")
def model(arm: Arm) -> Model:
    """Sag, and play in two joints that the path turns."""
    return declared_model(arm).plus(Backlash(joint=1, width=4e-3), Backlash(joint=3, width=1e-3))


def plan_of(arm: Arm, count: int = 41) -> PlannedPath:
    """From rest to rest, there and back: every joint turns once."""
    times = np.linspace(0.0, SECONDS, count)
    share = times / SECONDS
    along = share**3 * (10 - 15 * share + 6 * share**2)
    reach = 0.2 * (arm.upper - arm.lower) * np.linspace(0.6, 1.0, arm.n)
    joints = arm.mid + reach * np.sin(np.pi * along)[:, None]
    return PlannedPath.of_joints(arm, times, joints)


def follow(
    model: Model, plan: PlannedPath, predictor: object = None, **more: object
) -> CompensatedPath:
    limits = {name: more.pop(name) for name in PathLimits.__annotations__ if name in more}
    known = {"start": plan.joints[0], "history": History.unknown(model.arm.n)} | more
    return compensate_path(
        model, predictor, plan, limits=PathLimits(**{"turn_m": 0.0} | limits),
        context_at=lambda arrived: Context(**arrived.fields()), **known,
    )  # fmt: skip


def misses(model: Model, joints: np.ndarray, plan: PlannedPath) -> np.ndarray:
    """By how much the tip misses the plan where joints go one after another, m."""
    history, found = History.unknown(model.arm.n), []
    for before, now, target in zip(joints, joints[1:], plan.targets[1:], strict=False):
        history = history.after(now[None], before)
        tip = model.tip(now, Context(**history.fields()))
        found.append(np.linalg.norm(tip - target[:3, 3]))
    return np.array(found)


def test_the_tip_follows_the_plan_through_sag_play_and_turns(arm: Arm, model: Model) -> None:
    plan = plan_of(arm)
    found = follow(model, plan, max_longer=0.0)
    assert misses(model, plan.joints, plan).min() > 5e-3  # uncompensated
    assert misses(model, found.timed.joints, plan).max() < 2e-6
    np.testing.assert_array_equal(found.timed.joints[0], plan.joints[0])  # it stands there
    np.testing.assert_array_equal(found.timed.times, plan.times)  # nothing limits it
    assert found.timed.stretch == 1.0
    shift = np.abs(np.diff(found.timed.joints - plan.joints, axis=0))[1:]
    assert (shift[:, [1, 3, 4, 5, 6]] < 2e-3).all()  # of joints without play nothing jumps
    turned = np.flatnonzero(shift[:, 0] > 3e-3)
    assert len(turned) == 1 and 18 <= turned[0] <= 21  # the play of joint 1 is taken up once
    assert found.correction_m[1:].min() > 5e-3
    assert found.history.approach.tolist() == [-1.0] * arm.n


def test_play_is_taken_up_while_its_joint_stands_near_its_turn(arm: Arm) -> None:
    """The true joint stands still as long as its command is inside its play."""
    bent, width = declared_model(arm), 4e-3
    model = bent.plus(FrictionHysteresis(joint=1, width=width))
    plan = plan_of(arm, 401)
    quick, gentle = (follow(model, plan, turn_m=turn_m).timed for turn_m in (0.0, 1e-4))
    half = np.zeros(arm.n)
    half[0] = 0.5 * width
    for path, most in ((quick, 2e-5), (gentle, 1.5e-4)):
        stands = path.joints - lagging(path.joints, half, np.zeros(arm.n))
        off = np.linalg.norm(bent.tip(stands) - plan.targets[:, :3, 3], axis=1)
        moving = np.abs(path.joints[:, 0] - path.joints[0, 0]) > width  # its play is taken up
        assert off[moving].max() < most
    steps = [np.abs(np.diff(path.joints[:, 0] - plan.joints[:, 0])) for path in (quick, gentle)]
    assert steps[0][150:].max() > 0.9 * width and steps[1][150:].max() < 0.5 * width


def test_a_path_slows_down_where_a_joint_turns_so_that_its_play_costs_no_jerk(arm: Arm) -> None:
    model, unit = declared_model(arm), arm.upper - arm.lower
    for joint in (1, 2, 3):  # that turn together: each alone would jerk no more
        model = model.plus(FrictionHysteresis(joint=joint, width=4e-3))
    plan = plan_of(arm, 201)
    assert plan.times is not None and plan.joints is not None
    own = CubicPath(plan.times, plan.joints, smooth_slopes(plan.times, plan.joints))
    paths = {
        longer: follow(
            model, plan, turn_m=1e-4, max_longer=longer, start=None, history=came_up(arm, plan)
        ).timed
        for longer in (0.0, 0.1, 1.0)
    }
    jerk = {
        k: path.mean_square_jerk(unit) / own.mean_square_jerk(unit) for k, path in paths.items()
    }
    assert jerk[0.0] > 100.0 * jerk[1.0] and jerk[0.0] > 2.0 * jerk[0.1] > 2.0 * jerk[1.0]
    assert jerk[1.0] < 1.03
    assert 1.1 < paths[1.0].stretch < 2.0  # all that it takes
    assert 1.07 < paths[0.1].stretch <= 1.1 + 1e-9
    lasts = np.diff(paths[1.0].times) / np.diff(plan.times)
    assert np.argmax(lasts) in range(95, 106) and lasts[:40].max() < 1.01 > lasts[-40:].max()


def came_up(arm: Arm, plan: PlannedPath) -> History:
    """Every joint came to the plan's start from below."""
    assert plan.joints is not None
    return History.unknown(arm.n).after(plan.joints[:1], plan.joints[0] - 0.05)


def test_between_way_points_no_joint_leaves_its_range(arm: Arm) -> None:
    """At its limit a joint turns between two way-points: a smooth path would go beyond."""
    times = np.linspace(0.0, SECONDS, 8)
    joints = arm.mid + np.outer(np.sin(np.pi * times / SECONDS), 0.1 * (arm.upper - arm.lower))
    plan = PlannedPath.of_joints(arm, times, joints)
    box = replace_limits(arm, joints[:, 0].max())
    made = compensate_path(
        Model(box), None, plan, start=joints[0], history=History.unknown(arm.n),
        context_at=lambda arrived: Context(**arrived.fields()),
    ).timed  # fmt: skip
    free = CubicPath(times, joints, smooth_slopes(times, joints))
    assert (free.extremes()[1] > joints.max(axis=0) + 1e-3)[0]
    assert made.extremes()[1][0] <= box.upper[0] + 1e-12
    assert made.extremes()[1][1] > joints[:, 1].max() + 1e-3  # only that one


def replace_limits(arm: Arm, upper: float) -> Arm:
    """The arm with another upper limit of its first joint."""
    data = arm.model_dump(mode="json", exclude_none=True)
    data["joints"][0]["limits_deg"][1] = float(np.degrees(upper))
    return Arm.parse(data, "limited")


def test_a_path_that_begins_against_its_play_takes_it_up_first_and_gently(arm: Arm) -> None:
    model = declared_model(arm).plus(FrictionHysteresis(joint=1, width=8e-3))
    times, joints = plan_of(arm, 101).times, plan_of(arm, 201).joints[:101]
    assert times is not None and joints is not None
    span, jerks = arm.upper - arm.lower, []
    for away in (-0.1, 0.1):  # it came to the start as it goes on, and the other way
        came = History.unknown(arm.n).after(joints[:1], joints[0] + away)
        path = compensate_path(
            model, None, PlannedPath.of_joints(arm, times, joints), start=None, history=came,
            context_at=lambda arrived: Context(**arrived.fields()),
        ).timed  # fmt: skip
        each = np.diff(path.times)
        middle = path.at(path.times[:-1] + 0.5 * each, 3) / span
        jerks.append(np.sqrt(np.average((middle**2).sum(axis=1), weights=each)))
    assert path.stretch > 1.05
    assert jerks[1] < 1.1 * jerks[0]


def test_a_path_that_is_where_the_arm_stands_is_its_one_way_point(arm: Arm, model: Model) -> None:
    """A goal of one point at 0 s: it failed with a ValueError about the shape of an array."""
    found = follow(model, PlannedPath.of_joints(arm, np.zeros(1), arm.mid[None]))
    np.testing.assert_array_equal(found.timed.joints, arm.mid[None])
    assert found.notes == ()


def test_a_path_of_many_way_points_says_what_single_targets_say(arm: Arm, model: Model) -> None:
    plan = plan_of(arm, 7)
    found = follow(model, plan)
    answers, history = (found.each(model, Method.DEFLECTION, plan.targets), History.unknown(arm.n))
    for row in range(1, 7):
        before, now = found.timed.joints[row - 1 : row + 1]
        history = history.after(now[None], before)
        alone = compensate(
            model, None, plan.targets[row], context=Context(**history.fields()), seed=now,
            method=Method.DEFLECTION, starts=1,
        )[0]  # fmt: skip
        answer = answers[row]
        np.testing.assert_allclose(answer.command, alone.command, atol=1e-6)
        assert answer.expected_m == pytest.approx(alone.expected_m, rel=1e-3)
        assert answer.reason == alone.reason and answer.status is alone.status
    assert "joint1" in answer.reason or not answer.reason


def test_a_way_that_cannot_be_gone_is_refused_whole_and_in_words(arm: Arm, model: Model) -> None:
    plan = plan_of(arm)
    off = plan.joints[0] + 0.1 * np.eye(arm.n)[0]
    for row, given, words in (
        (r"\d+", {"options": CompensationOptions(max_correction_m=4e-3)}, "permitted 4 mm"),
        (0, {"start": off, "options": CompensationOptions(max_correction_m=0.05)}, "permitted 50"),
        (0, {"start": off, "max_start": 0.09}, "stands 0.1 from where the plan begins, allowed"),
    ):
        with pytest.raises(PathRefused, match=f"way-point {row}: correction_too_large: .*{words}"):
            follow(model, plan, **given)
    follow(model, plan, start=plan.joints[0] + 0.08 * np.eye(arm.n)[-1], max_start=0.09)
    edge = PlannedPath.of_joints(
        arm, plan.times, plan.joints + (arm.upper - plan.joints.max(axis=0))
    )
    with pytest.raises(PathRefused) as refused:
        follow(model, edge, start=arm.mid)
    assert refused.value.status is Status.UNREACHABLE and 15 < refused.value.row < 26
    box = declared_model(arm).tip(plan.joints[20])
    lamp = {"min_m": (box - 0.01).tolist(), "max_m": (box + 0.01).tolist()}
    fenced = Arm.parse(dict(read_yaml(ARM)) | {"keep_out": {"lamp": lamp}}, "fenced")
    with pytest.raises(PathRefused, match=r"way-point 1\d: kept_out: keep_out lamp"):
        follow(declared_model(fenced), PlannedPath.of_joints(fenced, plan.times, plan.joints))
    for name, bad in (
        ("time", PlannedPath.of_joints(arm, plan.times[::-1], plan.joints)),
        ("joints", PlannedPath(plan.targets, plan.times, plan.joints[:3])),
    ):
        with pytest.raises(InputError, match=name):
            follow(model, bad, start=arm.mid)


@pytest.mark.parametrize("free", [False, True])
def test_an_arm_that_cannot_hold_the_orientation_follows_the_positions_and_says_so(
    free: bool,
) -> None:
    bent = Model(SMALL, (DhError(row=2, alpha=0.02), DhError(row=4, alpha=0.03)))
    plan = plan_of(SMALL)
    found = follow(bent, plan, position_only=free)
    poses = bent.pose(found.timed.joints)[1:]
    wanted = plan.targets[1:]
    np.testing.assert_allclose(poses[:, :3, 3], wanted[:, :3, 3], atol=2e-6)
    turned = np.swapaxes(poses[:, :3, :3], 1, 2) @ wanted[:, :3, :3]
    off = Rotation.from_matrix(turned).magnitude()
    assert off.min() > 0.01
    shift = np.diff(found.timed.joints - plan.joints, axis=0)[1:]
    assert np.abs(shift).max() < 2e-3  # no joint jumps
    if free:
        assert not found.turn_rad.any() and not found.notes
        return
    np.testing.assert_allclose(found.turn_rad[1:], off, atol=1e-6)
    said = f"it is off by up to {np.degrees(off.max()):.2g} deg, at way-point {1 + off.argmax()}"
    assert said in found.notes[0] and not found.turn_rad[0]
    with pytest.raises(PathRefused, match=r"unreachable: its orientation .* allowed 0.01 rad"):
        follow(bent, plan, max_turn_rad=0.01)


def test_what_the_predictor_cannot_answer_for_is_not_corrected_in_part(
    arm: Arm, model: Model
) -> None:
    plan = plan_of(arm, 11)

    class Doubtful:
        asked = 0

        def predict(self, q: np.ndarray, context: Context) -> Prediction:
            self.asked += 1
            known = np.array([self.asked < 20])
            return Prediction(
                error=np.array([[2e-3, 0.0, 0.0]]), sigma=np.full((1, 3), 1e-4), in_domain=known,
                reason=["too far out"],
            )  # fmt: skip

    found = follow(model, plan, Doubtful())
    assert "physics only" in found.notes[0] and "too far out" in found.notes[0]
    np.testing.assert_allclose(found.timed.joints, follow(model, plan).timed.joints, atol=1e-7)


def between(path: CubicPath) -> np.ndarray:
    """List times on the path: 16 in every segment, the first and last just inside its ends."""
    share = np.linspace(1e-9, 1.0 - 1e-9, 16)
    return (path.times[:-1, None] + np.diff(path.times)[:, None] * share).ravel()


def test_limits_are_kept_nowhere_faster_than_the_plan(arm: Arm, model: Model) -> None:
    plan = plan_of(arm)
    free = follow(model, plan).timed
    peak = np.abs(free.at(between(free), 1)).max(axis=0)
    limits = MotionLimits(0.6 * peak, np.full(arm.n, 2.0))
    assert limits.excess(free) > 1.5
    timed = follow(model, plan, motion=limits).timed
    np.testing.assert_array_equal(timed.joints, free.joints)
    inside = between(timed)
    assert (np.abs(timed.at(inside, 1)) <= limits.velocity * (1 + 1e-5)).all()
    assert (np.abs(timed.at(inside, 2)) <= limits.acceleration * (1 + 1e-5)).all()
    assert (np.diff(timed.times) >= np.diff(plan.times) - 1e-9).all()
    assert timed.stretch == pytest.approx(timed.times[-1] / SECONDS) and timed.stretch < 3.0
    assert not timed.velocities[[0, -1]].any()


def test_random_ways_are_timed_within_limits() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        ways = np.cumsum(0.05 * rng.normal(size=(30, 4)), axis=0)
        limits = MotionLimits(np.full(4, 0.5), rng.uniform(1.0, 4.0, 4))
        quick = find_fastest_way(ways, limits)
        slow = np.linspace(0.0, 5.0, 30)
        for timed in (quick, retime(CubicPath(slow, ways, monotone_slopes(slow, ways)), limits)):
            assert limits.excess(timed) <= 1.0 + 1e-5
        least = (np.abs(np.diff(ways, axis=0)) / limits.velocity).max(axis=1).sum()
        assert least < quick.times[-1] < 4.0 * least
        kept = CubicPath(20.0 * slow, ways, monotone_slopes(20.0 * slow, ways))
        assert retime(kept, limits) is kept


def test_what_has_no_limit_slows_nothing() -> None:
    rng = np.random.default_rng(3)
    ways, slow = np.cumsum(0.05 * rng.normal(size=(30, 4)), axis=0), np.linspace(0.0, 5.0, 30)
    path = CubicPath(slow, ways, monotone_slopes(slow, ways))
    velocity = np.array([0.05, np.inf, np.inf, np.inf])
    acceleration = np.array([np.inf, 0.5, np.inf, np.inf])
    limits = MotionLimits(velocity, acceleration)
    timed = retime(path, limits)
    assert limits.excess(path) > 1.5 and limits.excess(timed) <= 1.0 + 1e-5
    wide = MotionLimits(np.minimum(velocity, 1e9), np.minimum(acceleration, 1e9))
    np.testing.assert_allclose(timed.times, retime(path, wide).times, rtol=1e-9)


def test_without_toppra_only_a_path_that_is_too_fast_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "toppra", None)
    times, ways = np.linspace(0.0, 1.0, 5), np.linspace(0.0, 1.0, 5)[:, None]
    path = CubicPath(times, ways, monotone_slopes(times, ways))
    assert retime(path, MotionLimits(np.array([9.0]), np.array([99.0]))) is path
    with pytest.raises(JobError, match=r"longarm_comp\[path\]"):
        retime(path, MotionLimits(np.array([0.5]), np.array([99.0])))


def test_paths_from_python_and_from_files_are_the_same(
    arm: Arm, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = plan_of(arm, 21)
    xyz = plan.targets[:, :3, 3]
    cells = np.column_stack([plan.times, xyz]).tolist()
    rows = ["t_s,x,y,z", *(",".join(map(str, row)) for row in cells)]
    (tmp_path / "waypoints.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "arm.yaml").write_text(ARM.read_text())
    shell = Shell(tmp_path, capsys)
    files = (tmp_path / "arm.yaml", "--path", tmp_path / "waypoints.csv")
    output = ("-o", tmp_path / "commands.csv", "--max-velocity", 0.2, "--max-acceleration", 1.0)
    assert shell("compensate", *files, *output) == 0, shell.err
    with (tmp_path / "commands.csv").open() as file:
        lines = list(csv.DictReader(file))
    found = la.compensate_path(
        declared_model(arm), xyz, times=plan.times, max_velocity=0.2, max_acceleration=1.0
    )
    told = np.array([[float(line[f"q{j}"]) for j in range(1, 8)] for line in lines])
    sides = [[float(line[f"approach_q{j}"]) for j in range(1, 8)] for line in lines]
    ways = np.diff(found.command, axis=0, prepend=found.command[:1])
    np.testing.assert_array_equal(sides, np.where(np.abs(ways) < 1e-6, 0.0, np.sign(ways)))
    assert {-1.0, 0.0, 1.0} == set(np.ravel(sides)) and not any(x["run_up_q1"] for x in lines)
    np.testing.assert_allclose(told, found.command, atol=1e-8)
    np.testing.assert_allclose([float(x["t_s"]) for x in lines], found.timed.times, atol=1e-6)
    speeds = np.array([[float(line[f"v_q{j}"]) for j in range(1, 8)] for line in lines])
    assert np.abs(speeds).max() <= 0.2 + 1e-6
    np.testing.assert_allclose(declared_model(arm).tip(told), xyz, atol=2e-6)
    far = xyz.copy()
    far[7] += 3.0
    with pytest.raises(PathRefused, match="way-point 7: unreachable"):
        la.compensate_path(declared_model(arm), far)
    (tmp_path / "commands.csv").unlink()
    (tmp_path / "waypoints.csv").write_text("x,y,z\n9,9,9\n")
    assert "way-point 0: unreachable" in shell.refused("compensate", *files, *output, code=3)
    assert not (tmp_path / "commands.csv").exists()
    assert "--path" in shell.refused("compensate", *files, "--targets", "waypoints.csv")
