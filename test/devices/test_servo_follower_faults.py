"""Every way the trajectory follower must stop, and how it goes on."""

import contextlib
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from follower_rig import CONFIG, DT, LIMITS, SLIDE, TURN, Rig, kinds, servo_state

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.follower_report import EventKind, FollowerState, Step
from longarm_comp.devices.joint_path import JointTrajectory
from longarm_comp.devices.servo_bus.state import ServoAlarm
from longarm_comp.devices.servo_watch import ServoTrouble, ServoWatch, stands_in_its_droop


@pytest.fixture
def rig() -> Rig:
    return Rig()


def _troubles(steps: list[Step]) -> list[tuple[ServoTrouble, str]]:
    findings = [event.finding for step in steps for event in step.events]
    return [(f.trouble, f.joint) for f in findings if f is not None]


def _moving(rig: Rig) -> Rig:
    rig.send((4.0, {"turn": 0.9, "slide": 0.09}))
    rig.run(1.0)
    return rig


def test_a_missing_read_back_freezes_and_then_goes_on(rig: Rig) -> None:
    _moving(rig)
    before = rig.trace[-1]
    steps = rig.run(0.1, hide=(9,))
    assert all(s.goals is None and s.set_points == before for s in steps)
    assert kinds(steps) == [EventKind.DOUBTFUL]
    assert rig.step().goals is not None
    rig.run(5.0)
    assert rig.column("slide")[-1] == pytest.approx(0.09)


def test_a_silent_servo_is_a_fault_that_holds_the_others(rig: Rig) -> None:
    _moving(rig)
    here = {5: rig.states[5].position_ticks}  # the silent one keeps its last goal
    steps = rig.run(0.6, hide=(9,))
    assert _troubles(steps) == [(ServoTrouble.SILENT, "slide")]
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
    assert _troubles(steps) == [(ServoTrouble.STALLED, "turn")]
    hold = next(s.goals for s in steps if s.state is FollowerState.FAULT)
    assert hold is not None and hold[5] == stuck


@pytest.mark.parametrize(("max_load", "stalls"), [(0.4, True), (0.6, False)])
def test_a_joint_may_have_a_load_limit_of_its_own(max_load: float, stalls: bool) -> None:
    joints = {
        name: j.model_copy(update={"max_load": max_load}) for name, j in CONFIG.joints.items()
    }
    rig = Rig(CONFIG.model_copy(update={"joints": joints}))
    rig.obeys.discard(5)
    rig.states[5] = replace(rig.states[5], load=-0.5)
    rig.send((0.5, {"turn": 0.3}))  # less off than counts as not following
    assert _troubles(rig.run(3.0)) == ([(ServoTrouble.STALLED, "turn")] if stalls else [])


def test_a_stall_must_last_and_a_reset_forgets_it(rig: Rig) -> None:
    rig.obeys.discard(5)
    rig.states[5] = replace(rig.states[5], load=0.95)
    rig.send((0.5, {"turn": 0.3}))
    assert _troubles(rig.run(1.2 * LIMITS.stall_time_s)) == []  # it pushes from half of it on
    assert _troubles(rig.run(0.5)) == [(ServoTrouble.STALLED, "turn")]
    rig.follower.reset(rig.now)
    rig.send((0.5, {"turn": 0.3}))
    assert _troubles(rig.run(0.3)) == []  # pushing, but not for long


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize(("beyond", "back"), [(40, 40), (41, 0), (2500, 0)])
def test_a_fault_holds_a_joint_at_its_limit_only_where_that_is_no_motion(
    rig: Rig, end: int, beyond: int, back: int
) -> None:
    """A goal far off is approached at the servo's top speed."""
    rig.run(0.1)
    rig.follower.hold_at({5: rig.states[5].position_ticks})
    side = (-1, 1)[end]
    at = TURN.tick_limits[end] + side * beyond
    for _ in range(2):  # somebody moved it there
        rig.states[5] = servo_state(at)
        rig.step()
    rig.states[5] = servo_state(at, temperature_c=99.0)
    (hold,) = [s.goals for s in rig.run(0.1) if s.state is FollowerState.FAULT and s.goals]
    assert hold[5] == at - side * back


def test_a_short_peak_of_load_is_no_stall(rig: Rig) -> None:
    _moving(rig)
    rig.states[5] = replace(rig.states[5], load=1.0)
    assert _troubles(rig.run(2.0)) == []


def test_a_servo_that_does_not_follow_is_a_fault_without_load(rig: Rig) -> None:
    rig.obeys.discard(5)
    steps = _moving(rig).run(4.0)
    assert _troubles(steps) == [(ServoTrouble.NOT_FOLLOWING, "turn")]


@pytest.mark.parametrize("at_once", [True, False])
def test_a_servo_may_stand_between_the_last_two_goals(at_once: bool) -> None:
    """On a busy machine goals are far apart; the servo is read before it has moved, or after."""
    limits = LIMITS.model_copy(update={"lost_error_ticks": 5.0})
    rig = Rig(CONFIG.model_copy(update={"follower": limits}))
    if not at_once:
        rig.obeys.clear()
    rig.send((2.0, {"turn": 0.9}))
    steps, sent = [], dict[int, int]()
    for _ in range(30):
        for servo_id, goal in sent.items() if not at_once else ():  # of the cycle before
            rig.states[servo_id] = replace(rig.states[servo_id], position_ticks=goal)
        steps.append(rig.step(0.1))
        sent, last = steps[-2].goals or {} if len(steps) > 1 else {}, steps[-1].goals
    assert max(np.diff(rig.column("turn"))) > 5 * TURN.si_per_tick
    assert _troubles(steps) == [] and last is not None


@pytest.mark.parametrize(
    ("changes", "trouble"),
    [
        ({"temperature_c": 66.0}, ServoTrouble.OVERHEATED),
        ({"temperature_c": math.nan}, ServoTrouble.OVERHEATED),
        ({"error_flags": ServoAlarm.OVERLOAD}, ServoTrouble.ALARM),
    ],
)
def test_heat_and_alarms_are_faults_also_while_holding(
    rig: Rig, changes: dict[str, Any], trouble: ServoTrouble
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


def test_one_reply_alone_is_no_alarm(rig: Rig) -> None:
    """One damaged reply in 256 passes its checksum; the arm waits until the next one."""
    _moving(rig)
    healthy = rig.states[9]
    rig.states[9] = replace(healthy, error_flags=ServoAlarm.OVERLOAD)
    step = rig.step()
    assert (step.goals, kinds([step])) == (None, [EventKind.DOUBTFUL])
    with pytest.raises(JobError, match="no fresh reading"):
        rig.send((0.5, {"turn": 0.3}))
    rig.states[9] = healthy
    assert rig.step().goals is not None
    rig.run(5.0)
    assert rig.column("turn")[-1] == pytest.approx(0.9)


@pytest.mark.parametrize("readings", ["missing", "doubtful", "late"])
def test_a_stop_brakes_whatever_was_read(rig: Rig, readings: str) -> None:
    _moving(rig)
    healthy = rig.states[9]
    if readings == "doubtful":
        rig.states[9] = replace(healthy, error_flags=ServoAlarm.OVERLOAD)
    if readings == "late":
        rig.now += 2.0 * LIMITS.silence_s
    else:
        rig.step(hide=(9,) if readings == "missing" else ())
    with pytest.raises(JobError, match="no fresh reading"):
        rig.send((1.0, {"turn": 0.9}))
    before = rig.follower.set_points
    assert rig.follower.accept(JointTrajectory((), ()), rig.now).replaces
    rig.states[9] = healthy
    steps = rig.run(2.0)
    assert [kind for kind in kinds(steps) if kind is not EventKind.DOUBTFUL] == [
        EventKind.REPLACED, EventKind.ARRIVED,
    ]  # fmt: skip
    braking = TURN.max_velocity * LIMITS.blend_s
    assert 0.0 <= rig.follower.set_points["turn"] - before["turn"] <= braking


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
    assert _troubles(rig.run(0.6)) == [(ServoTrouble.SILENT, "turn")]


@pytest.mark.parametrize("turns", [-1, 1])
def test_a_lost_count_of_turns_is_not_believed_however_long_it_is_told(turns: int) -> None:
    watch, goals = ServoWatch(CONFIG), {5: 2000, 9: 3000}
    here = {servo_id: servo_state(ticks) for servo_id, ticks in goals.items()}
    assert watch.update(0.0, here, goals)[0]
    lost = here | {5: servo_state(2000 + turns * 4096)}
    for now in (0.02, 1.0, 5.0, 60.0):
        assert not watch.update(now, lost, goals)[0] and not watch.was_heard("turn")
    assert watch.update(61.0, here, goals)[0]


def test_while_idle_one_false_read_back_is_not_believed_but_a_hand_is(rig: Rig) -> None:
    true = rig.states[5]
    rig.states[5] = replace(true, position_ticks=true.position_ticks + 500)
    rig.step()
    with pytest.raises(JobError, match="fresh reading"):
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
    rig.states[5] = servo_state(2100)  # fell while the torque was off
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
    assert _troubles([step]) == [(ServoTrouble.LET_GO, "slide")]


@pytest.mark.parametrize("torque", [True, False])
def test_a_hot_or_alarmed_servo_is_a_fault_also_before_the_first_move(torque: bool) -> None:
    """A heavy arm may hang there for hours; without torque nothing holds it anyway."""
    for ill in ({"temperature_c": 70.0}, {"error_flags": ServoAlarm.OVERLOAD}):
        rig = Rig()
        rig.run(0.1)
        at = rig.states[5].position_ticks
        if torque:
            rig.follower.hold_at({5: at + 10})
        rig.states[5] = replace(rig.states[5], **ill)  # type: ignore[arg-type]
        steps = rig.run(0.1)
        assert (rig.follower.state is FollowerState.FAULT) is torque
        assert [s.goals[5] for s in steps if s.goals] == [at] * torque


def test_a_cable_that_is_out_for_a_while_before_the_first_move_is_no_fault(rig: Rig) -> None:
    """Nothing is sent then; and nothing is taken either until every servo answers."""
    rig.run(0.1)
    rig.follower.hold_at({5: rig.states[5].position_ticks})
    rig.run(1.0, hide=(5, 9))
    assert rig.follower.state is FollowerState.IDLE
    with pytest.raises(JobError, match="no fresh reading"):
        rig.send((4.0, {"slide": 0.09}))
    rig.run(0.1)
    rig.send((4.0, {"slide": 0.09}))


@pytest.mark.parametrize(
    ("off", "speed", "load", "stands"),
    [
        (30, 0.0, 1.0, True),  # below what counts as a stall, at any load
        (100, 0.0, 0.6, True),
        (100, 0.0, 1.0, False),  # it pushes against something
        (100, 0.0, -1.0, False),
        (30, 200.0, 0.3, False),  # on its way
        (401, 0.0, 0.6, False),  # no droop is as large
        (-100, -1.0, 0.6, True),
    ],
)
def test_only_a_servo_that_stands_in_its_droop_keeps_its_goal(
    off: int, speed: float, load: float, stands: bool
) -> None:
    state = replace(servo_state(1000), velocity_ticks_s=speed, load=load)
    assert stands_in_its_droop(state, 1000 + off, TURN, LIMITS) is stands


def test_a_trajectory_begins_at_the_goals_that_hold_the_arm() -> None:
    """The joint that hangs in its droop does not sink first, one that was carried away stays."""
    for off, begins in ((30, 30), (2000, 0)):
        rig = Rig()
        rig.run(0.1)
        at = rig.states[5].position_ticks
        rig.follower.hold_at({5: at + off})
        rig.send((4.0, {"slide": 0.09}))
        assert rig.step().goals[5] == at + begins


def test_a_few_looks_far_apart_are_not_half_a_second_of_disobedience(rig: Rig) -> None:
    _moving(rig)
    rig.obeys.discard(5)
    rig.states[5] = replace(rig.states[5], position_ticks=TURN.to_ticks(-0.9))
    looks = int(LIMITS.stall_time_s / LIMITS.max_step_s)
    assert _troubles([rig.step(dt=0.6) for _ in range(looks)]) == []
    assert _troubles(rig.run(1.0)) == [(ServoTrouble.NOT_FOLLOWING, "turn")]


@pytest.mark.parametrize(
    ("turns", "late", "believed"), [(0, 1.0, True), (-1, 1.0, False), (0, 0.02, False)]
)
def test_more_than_half_a_turn_in_a_late_cycle_is_believed_on_the_way_to_the_goal(
    turns: int, late: float, believed: bool
) -> None:
    slow = {"max_step_s": 1.0, "silence_s": 5.0, "stall_time_s": 5.0}
    rig = Rig(CONFIG.model_copy(update={"follower": LIMITS.model_copy(update=slow)}))
    rig.obeys.clear()
    rig.send((1.4, {"slide": 0.1}))
    for _ in range(3):
        last = rig.step(dt=1.0)
    assert last.goals is not None
    went = last.goals[9] - rig.states[9].position_ticks
    assert abs(went) > 2048
    at = last.goals[9] + 4096 * turns
    rig.states[9] = replace(rig.states[9], position_ticks=at)
    assert EventKind.DOUBTFUL not in kinds([last])
    assert (EventKind.DOUBTFUL not in kinds([rig.step(dt=late)])) == believed
