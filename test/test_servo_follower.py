"""The trajectory follower with a fake clock: bounds, smoothness, and every way it must stop."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint, plan_path
from longarm_comp.devices.servo_bus import ServoAlarm, ServoState
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_follower import EventKind, FollowerState, Step, TrajectoryFollower
from longarm_comp.devices.servo_watch import Trouble

DT = 0.02
CONFIG = ServoConfig.parse(
    {
        "bus": {"protocol": "feetech", "port": "/dev/null"},
        "joints": {
            "turn": {
                "servo_id": 5,
                "model": "sts3215",
                "type": "revolute",
                "zero_ticks": 2048,
                "lower": -1.0,
                "upper": 1.0,
                "max_velocity": 0.8,
            },
            "slide": {
                "servo_id": 9,
                "model": "sts3215",
                "type": "prismatic",
                "pinion_radius_m": 0.018,
                "zero_ticks": 4000,
                "direction": -1,
                "lower": 0.0,
                "upper": 0.1,
                "max_velocity": 0.05,
            },
        },
    },
    "test",
)
TURN, SLIDE = CONFIG.joints.values()
LIMITS = CONFIG.follower


def _state(ticks: int, **changes: Any) -> ServoState:
    return replace(ServoState(ticks, 0.0, 0.0, 7.4, 30.0, False), **changes)


class Rig:
    """A follower on servos that go where they are told within one step."""

    def __init__(self) -> None:
        self.follower = TrajectoryFollower(CONFIG)
        self.now = 100.0
        self.states = {5: _state(TURN.to_ticks(0.2)), 9: _state(SLIDE.to_ticks(0.03))}
        self.obeys = {5, 9}
        self.trace: list[dict[str, float]] = []
        self.step()

    def step(self, dt: float = DT, hide: tuple[int, ...] = ()) -> Step:
        self.now += dt
        step = self.follower.step(self.now, {i: s for i, s in self.states.items() if i not in hide})
        for servo_id in self.obeys & set(step.goals or ()):
            assert step.goals is not None
            goal = step.goals[servo_id]
            self.states[servo_id] = replace(self.states[servo_id], position_ticks=goal)
        self.trace.append(step.set_points)
        return step

    def send(self, *points: tuple[float, dict[str, float]]) -> None:
        names = tuple(points[0][1])
        self.follower.accept(
            JointTrajectory(
                names, tuple(TrajectoryPoint(t, tuple(q[n] for n in names)) for t, q in points)
            ),
            self.now,
        )

    def run(self, seconds: float, **kwargs: Any) -> list[Step]:
        return [self.step(**kwargs) for _ in range(round(seconds / DT))]

    def column(self, name: str) -> np.ndarray:
        return np.array([s[name] for s in self.trace if s])


@pytest.fixture
def rig() -> Rig:
    return Rig()


def _kinds(steps: list[Step]) -> list[EventKind]:
    return [event.kind for step in steps for event in step.events]


def _troubles(steps: list[Step]) -> list[tuple[Trouble, str]]:
    findings = [event.finding for step in steps for event in step.events]
    return [(f.trouble, f.joint) for f in findings if f is not None]


def test_idle_commands_nothing(rig: Rig) -> None:
    assert all(s.goals is None and s.set_points == {} for s in rig.run(0.5))
    assert rig.follower.state is FollowerState.IDLE


def test_it_passes_its_way_points_on_time_and_holds_at_the_last(rig: Rig) -> None:
    rig.send((1.0, {"turn": 0.4, "slide": 0.04}), (2.0, {"turn": 0.1, "slide": 0.05}))
    steps = rig.run(1.0)
    assert steps[-1].set_points["turn"] == pytest.approx(0.4, abs=1e-9)
    assert steps[-1].set_points["slide"] == pytest.approx(0.04, abs=1e-9)
    steps += rig.run(1.5)
    assert rig.follower.state is FollowerState.HOLDING
    assert steps[-1].set_points == pytest.approx({"turn": 0.1, "slide": 0.05}, abs=1e-12)
    assert steps[-1].goals == {5: TURN.to_ticks(0.1), 9: SLIDE.to_ticks(0.05)}
    assert _kinds(steps) == [EventKind.STARTED, EventKind.ARRIVED]


def test_arrival_waits_until_the_servos_rest(rig: Rig) -> None:
    rig.send((0.5, {"turn": 0.4}))
    rig.states[9] = replace(rig.states[9], velocity_ticks_s=200.0)
    assert EventKind.ARRIVED not in _kinds(rig.run(2.0))
    rig.states[9] = replace(rig.states[9], velocity_ticks_s=0.0)
    assert _kinds(rig.run(0.2)) == [EventKind.ARRIVED]


def test_a_joint_that_is_not_named_stays(rig: Rig) -> None:
    rig.send((0.0, {"turn": -0.5}))
    rig.run(4.0)
    assert rig.column("slide") == pytest.approx(rig.column("slide")[0])
    assert rig.column("turn")[-1] == pytest.approx(-0.5)


def test_a_single_point_at_time_zero_is_reached_within_the_velocity_limits(rig: Rig) -> None:
    rig.send((0.0, {"turn": -0.9, "slide": 0.09}))
    rig.run(6.0)
    for name, joint in CONFIG.joints.items():
        speed = np.abs(np.diff(rig.column(name))) / DT
        assert speed.max() <= joint.max_velocity * (1 + 1e-6)
    assert rig.column("turn")[-1] == pytest.approx(-0.9)
    assert rig.column("slide")[-1] == pytest.approx(0.09)


def test_a_trajectory_that_is_too_fast_is_slowed_down_evenly(rig: Rig) -> None:
    rig.send((0.1, {"turn": 0.9, "slide": 0.09}), (0.2, {"turn": -0.9, "slide": 0.01}))
    steps = rig.run(20.0)
    assert EventKind.SLOWED in _kinds(steps)
    for name, joint in CONFIG.joints.items():
        assert np.abs(np.diff(rig.column(name))).max() / DT <= joint.max_velocity * (1 + 1e-6)
    assert rig.column("turn").max() == pytest.approx(0.9, abs=0.02)
    assert rig.follower.state is FollowerState.HOLDING


def test_one_hasty_segment_does_not_slow_down_the_others(rig: Rig) -> None:
    rig.send((0.01, {"turn": 0.9}), (3.0, {"turn": 0.7}))
    rig.run(7.0)
    assert rig.follower.state is FollowerState.HOLDING


def test_replacing_a_running_trajectory_is_smooth(rig: Rig) -> None:
    """Position and velocity go on without a jump, and the new end is reached."""
    rig.send((2.0, {"turn": 0.9}))
    rig.run(0.8)
    rig.send((2.0, {"turn": -0.2}))
    steps = rig.run(3.0)
    assert EventKind.REPLACED in _kinds(steps)
    speed = np.diff(rig.column("turn")) / DT
    largest = 4.0 * TURN.max_velocity / LIMITS.blend_s * DT
    assert np.abs(np.diff(speed)).max() < largest
    assert np.abs(speed).max() <= TURN.max_velocity * (1 + 1e-6)
    assert rig.column("turn")[-1] == pytest.approx(-0.2)


def test_twenty_new_targets_a_second_stay_within_every_bound(rig: Rig) -> None:
    rng = np.random.default_rng(7)
    for _ in range(200):
        rig.send(
            (
                float(rng.uniform(0.0, 0.5)),
                {"turn": float(rng.uniform(-1, 1)), "slide": float(rng.uniform(0, 0.1))},
            )
        )
        rig.step(dt=float(rng.uniform(0.005, 0.08)))
        rig.step()
    for name, joint in CONFIG.joints.items():
        values = rig.column(name)
        assert values.min() >= joint.lower and values.max() <= joint.upper
        assert np.abs(np.diff(values)).max() <= joint.max_velocity * 0.08 * (1 + 1e-6)


def test_halt_brakes_and_holds(rig: Rig) -> None:
    rig.send((2.0, {"turn": 0.9}))
    rig.run(1.0)
    before = rig.column("turn")
    rig.follower.halt(rig.now)
    rig.run(1.0)
    after = rig.column("turn")[len(before) :]
    assert rig.follower.state is FollowerState.HOLDING
    assert np.all(np.diff(after) >= -1e-12)
    assert after[-1] - before[-1] < TURN.max_velocity * LIMITS.blend_s


def test_a_long_pause_between_steps_makes_no_long_step(rig: Rig) -> None:
    rig.send((4.0, {"turn": 0.9}))
    rig.run(1.0)
    before = rig.column("turn")[-1]
    rig.step(dt=0.2)
    assert rig.column("turn")[-1] - before <= TURN.max_velocity * LIMITS.max_step_s + 1e-9
    rig.now -= 5.0  # a clock that goes back moves nothing
    step = rig.step()
    assert step.set_points["turn"] == pytest.approx(rig.column("turn")[-2])


def _points(*rows: tuple[float, tuple[float, ...]], **kwargs: Any) -> JointTrajectory:
    names = kwargs.get("names", ("turn", "slide"))
    return JointTrajectory(names, tuple(TrajectoryPoint(t, q) for t, q in rows))


@pytest.mark.parametrize(
    ("trajectory", "said"),
    [
        (_points((1.0, (0.1,)), names=("elbow",)), "one of turn, slide"),
        (_points((1.0, (0.1, 0.1)), names=("turn", "turn")), "each joint once"),
        (_points((1.0, ()), names=()), "at least one of"),
        (_points((1.0, (0.1,))), "2 values"),
        (_points((1.0, (math.nan, 0.01))), "points[0].positions of turn"),
        (_points((1.0, (0.1, math.inf))), "points[0].positions of slide"),
        (_points((1.0, (1.1, 0.01))), "-1 to 1 rad"),
        (_points((1.0, (0.1, -0.01))), "0 to 0.1 m"),
        (_points((-1.0, (0.1, 0.01))), "points[0].time_from_start"),
        (_points((math.nan, (0.1, 0.01))), "points[0].time_from_start"),
        (_points((1.0, (0.1, 0.01)), (1.0, (0.2, 0.01))), "points[1].time_from_start"),
        (
            JointTrajectory(
                ("turn",),
                (TrajectoryPoint(1.0, (0.1,), (0.0,)), TrajectoryPoint(2.0, (0.1,))),
            ),
            "at every point or at none",
        ),
        (
            JointTrajectory(("turn",), (TrajectoryPoint(1.0, (0.1,), (math.inf,)),)),
            "points[0].velocities of turn",
        ),
        (
            JointTrajectory(
                ("turn",),
                (TrajectoryPoint(2.0, (0.95,), (0.7,)), TrajectoryPoint(4.0, (0.9,), (0.0,))),
            ),
            "turn on the way",
        ),
    ],
)
def test_a_bad_trajectory_is_refused_with_a_reason_and_changes_nothing(
    rig: Rig, trajectory: JointTrajectory, said: str
) -> None:
    rig.send((3.0, {"turn": 0.6}))
    rig.run(0.5)
    with pytest.raises(InputError) as caught:
        rig.follower.accept(trajectory, rig.now)
    assert said in str(caught.value)
    rig.run(3.0)
    assert rig.column("turn")[-1] == pytest.approx(0.6)


def test_nothing_is_taken_before_every_servo_was_heard() -> None:
    follower = TrajectoryFollower(CONFIG)
    target = _points((1.0, (0.1, 0.01)))
    with pytest.raises(JobError, match="fresh read-back"):
        follower.accept(target, 0.0)
    follower.step(0.0, {5: _state(2048)})
    with pytest.raises(JobError, match="fresh read-back"):
        follower.accept(target, 0.0)
    follower.step(0.02, {5: _state(2048), 9: _state(3900)})
    with pytest.raises(JobError, match="fresh read-back"):
        follower.accept(target, 5.0)
    follower.accept(target, 0.02)


def test_an_arm_outside_its_limits_or_too_hot_is_not_moved(rig: Rig) -> None:
    rig.states[5] = _state(TURN.to_ticks(1.0) + 200)
    rig.run(0.1)
    with pytest.raises(InputError, match="by hand"):
        rig.send((1.0, {"turn": 0.0}))
    rig.states[5] = _state(2048, temperature_c=80.0)
    rig.run(0.1)
    with pytest.raises(JobError, match="overheated"):
        rig.send((1.0, {"turn": 0.0}))


def _moving(rig: Rig) -> Rig:
    rig.send((4.0, {"turn": 0.9, "slide": 0.09}))
    rig.run(1.0)
    return rig


def test_a_missing_read_back_freezes_and_then_goes_on(rig: Rig) -> None:
    _moving(rig)
    before = rig.trace[-1]
    steps = rig.run(0.1, hide=(9,))
    assert all(s.goals is None and s.set_points == before for s in steps)
    assert _kinds(steps) == [EventKind.DOUBTFUL]
    assert rig.step().goals is not None
    rig.run(5.0)
    assert rig.column("slide")[-1] == pytest.approx(0.09)


def test_a_silent_servo_is_a_fault_that_holds_the_others(rig: Rig) -> None:
    _moving(rig)
    here = {5: rig.states[5].position_ticks}  # the silent one keeps its last goal
    steps = rig.run(0.6, hide=(9,))
    assert _troubles(steps) == [(Trouble.SILENT, "slide")]
    sent = [s.goals for s in steps if s.goals is not None]
    assert sent == [here]
    assert rig.follower.state is FollowerState.FAULT
    assert all(s.goals is None for s in rig.run(1.0))


def test_a_stalled_servo_is_a_fault_and_stops_pushing(rig: Rig) -> None:
    rig.obeys.discard(5)
    _moving(rig)
    stuck = rig.states[5].position_ticks
    rig.states[5] = replace(rig.states[5], load=0.95)
    steps = rig.run(1.5)
    assert _troubles(steps) == [(Trouble.STALLED, "turn")]
    hold = next(s.goals for s in steps if s.state is FollowerState.FAULT)
    assert hold is not None and hold[5] == stuck


def test_a_short_peak_of_load_is_no_stall(rig: Rig) -> None:
    _moving(rig)
    rig.states[5] = replace(rig.states[5], load=1.0)
    assert _troubles(rig.run(2.0)) == []


def test_a_servo_that_does_not_follow_is_a_fault_without_load(rig: Rig) -> None:
    rig.obeys.discard(5)
    steps = _moving(rig).run(4.0)
    assert _troubles(steps) == [(Trouble.NOT_FOLLOWING, "turn")]


@pytest.mark.parametrize(
    ("changes", "trouble"),
    [
        ({"temperature_c": 66.0}, Trouble.OVERHEATED),
        ({"temperature_c": math.nan}, Trouble.OVERHEATED),
        ({"error_flags": ServoAlarm.OVERLOAD}, Trouble.ALARM),
    ],
)
def test_heat_and_alarms_are_faults_also_while_holding(
    rig: Rig, changes: dict[str, Any], trouble: Trouble
) -> None:
    rig.send((0.5, {"turn": 0.3}))
    rig.run(2.0)
    assert rig.follower.state is FollowerState.HOLDING
    healthy = rig.states[9]
    rig.states[9] = replace(healthy, **changes)
    assert _troubles(rig.run(0.1)) == [(trouble, "slide")]
    with pytest.raises(JobError, match=trouble.value):
        rig.follower.reset(rig.now)
    with pytest.raises(JobError, match="reset"):
        rig.send((0.5, {"turn": 0.3}))
    rig.states[9] = healthy
    rig.step()
    rig.follower.reset(rig.now)
    assert rig.follower.state is FollowerState.IDLE
    rig.send((0.5, {"turn": 0.1}))
    rig.run(2.0)
    assert rig.column("turn")[-1] == pytest.approx(0.1)


def test_a_read_back_that_jumps_is_not_believed(rig: Rig) -> None:
    _moving(rig)
    true = rig.states[5]
    before = rig.trace[-1]
    rig.states[5] = replace(true, position_ticks=true.position_ticks + 1500)
    step = rig.step()
    assert step.goals is None and step.set_points == before
    rig.states[5] = true
    assert rig.step().goals is not None
    rig.obeys.discard(5)
    rig.states[5] = replace(true, position_ticks=true.position_ticks + 1500)
    assert _troubles(rig.run(0.6)) == [(Trouble.SILENT, "turn")]


def test_while_idle_one_false_read_back_is_not_believed_but_a_hand_is(rig: Rig) -> None:
    true = rig.states[5]
    rig.states[5] = replace(true, position_ticks=true.position_ticks + 500)
    rig.step()
    with pytest.raises(JobError, match="fresh read-back"):
        rig.send((1.0, {"turn": 0.0}))
    rig.step()  # the same again: somebody moved the arm
    rig.send((1.0, {"turn": 0.0}))
    step = rig.step()
    assert step.goals is not None
    assert abs(step.goals[5] - true.position_ticks - 500) <= TURN.max_speed_ticks_s * DT + 1


def test_the_emergency_stop_commands_nothing_until_reset(rig: Rig) -> None:
    _moving(rig)
    rig.follower.estop()
    steps = rig.run(1.0)
    assert all(s.goals is None and s.state is FollowerState.ESTOP for s in steps)
    with pytest.raises(JobError, match="reset"):
        rig.send((1.0, {"turn": 0.0}))
    rig.states[5] = _state(2100)  # fell while the torque was off
    rig.run(0.1)
    rig.follower.reset(rig.now)
    rig.send((1.0, {"turn": 0.0}))
    step = rig.step()
    assert step.goals is not None and abs(step.goals[5] - 2100) < 5


@pytest.mark.parametrize("seed", range(5))
def test_whatever_happens_goals_stay_within_limits_and_steps(seed: int) -> None:
    """Random targets, lost and false read-backs, resets: every goal sent obeys every bound."""
    rng = np.random.default_rng(seed)
    rig, sent, last_sent = Rig(), 0, dict[int, tuple[float, int]]()
    for _ in range(1500):
        with contextlib.suppress(InputError, JobError):
            if rng.random() < 0.1:
                rig.send((float(rng.uniform(0, 2)), {"turn": float(rng.uniform(-1.1, 1.1))}))
            if rig.follower.state is FollowerState.FAULT:
                rig.follower.reset(rig.now)
        true = dict(rig.states)
        if rng.random() < 0.03:
            false = int(rng.integers(-9000, 9000))
            rig.states[5] = replace(true[5], position_ticks=true[5].position_ticks + false)
        hide = (9,) if rng.random() < 0.05 else ()
        step = rig.step(dt=float(rng.choice([0.01, 0.02, 0.3], p=[0.49, 0.5, 0.01])), hide=hide)
        believed = step.goals if step.state is not FollowerState.FAULT else None
        for servo_id, goal in (believed or {}).items():
            joint = TURN if servo_id == 5 else SLIDE
            low, high = joint.tick_limits
            assert low <= goal <= high
            then, before = last_sent.get(servo_id, (rig.now, true[servo_id].position_ticks))
            gap = max(rig.now - then, 0.01)
            assert abs(goal - before) <= joint.max_speed_ticks_s * gap + 1.5
            last_sent[servo_id] = (rig.now, goal)
            sent += 1
        if step.state is FollowerState.FAULT:
            last_sent.clear()
        rig.states = {i: rig.states[i] if i in (step.goals or {}) else true[i] for i in true}
    assert sent > 500


def test_a_servo_that_let_go_is_a_fault(rig: Rig) -> None:
    _moving(rig)
    rig.now += DT
    assert rig.follower.step(rig.now, rig.states, {5: True, 9: True}).goals is not None
    step = rig.follower.step(rig.now + DT, rig.states, {5: True, 9: False})
    assert _troubles([step]) == [(Trouble.LET_GO, "slide")]


def test_a_clock_that_is_not_finite_is_refused(rig: Rig) -> None:
    with pytest.raises(InputError, match="finite seconds"):
        rig.follower.step(math.nan, {})


def _sampled(function: Callable[[float], np.ndarray], duration: float) -> np.ndarray:
    return np.array([function(t) for t in np.linspace(0.0, duration, 4001)])


@pytest.mark.parametrize("seed", range(8))
def test_peak_velocity_and_extremes_agree_with_sampling(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.2, 1.0, 5))
    positions = rng.uniform(-1, 1, (5, 3))
    velocities = rng.normal(size=(5, 3)) if seed % 2 else None
    path = plan_path(rng.uniform(-1, 1, 3), times, positions, velocities, np.full(3, 0.7))
    dense = _sampled(path.at, path.duration)
    low, high = path.extremes()
    assert low == pytest.approx(dense.min(axis=0), abs=1e-4)
    assert high == pytest.approx(dense.max(axis=0), abs=1e-4)
    speed = np.abs(np.diff(dense, axis=0)).max(axis=0) / (path.duration / 4000)
    assert path.peak_velocity() == pytest.approx(speed, rel=2e-3, abs=1e-6)
    assert path.peak_velocity().max() <= 0.7 * (1 + 1e-9)


def test_without_velocities_the_path_equals_scipys_monotone_interpolation() -> None:
    interpolate = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(3)
    times = np.array([1.0, 1.5, 3.0, 3.5])
    positions = rng.uniform(-0.1, 0.1, (4, 2))
    start = rng.uniform(-0.1, 0.1, 2)
    path = plan_path(start, times, positions, None, np.full(2, 10.0))
    assert path.stretch == 1.0
    scipys = interpolate.PchipInterpolator(path.times, path.positions)
    inner = scipys.derivative()(path.times)[1:-1]
    assert path.slopes[1:-1] == pytest.approx(inner)
    assert path.slopes[[0, -1]] == pytest.approx(np.zeros((2, 2)))
