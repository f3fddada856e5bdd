"""The trajectory follower with a fake clock: on time, smooth, and within every bound."""

from dataclasses import replace

import numpy as np
import pytest
from follower_rig import CONFIG, DT, LIMITS, SLIDE, TURN, Rig, kinds

from longarm_comp.core.vibration.modes import Modes
from longarm_comp.core.vibration.ring import find_amplitudes
from longarm_comp.devices.follower_report import EventKind, FollowerState
from longarm_comp.devices.joint_path import JointTrajectory
from longarm_comp.math.shaper import Shaper


@pytest.fixture
def rig() -> Rig:
    return Rig()


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
    assert kinds(steps) == [EventKind.STARTED, EventKind.ARRIVED]


def test_arrival_waits_until_the_servos_rest(rig: Rig) -> None:
    rig.send((0.5, {"turn": 0.4}))
    rig.states[9] = replace(rig.states[9], velocity_ticks_s=200.0)
    assert EventKind.ARRIVED not in kinds(rig.run(2.0))
    rig.states[9] = replace(rig.states[9], velocity_ticks_s=0.0)
    assert kinds(rig.run(0.2)) == [EventKind.ARRIVED]


def test_a_joint_that_rests_beside_its_end_has_not_arrived(rig: Rig) -> None:
    rig.obeys.discard(5)
    off = 1.5 * LIMITS.stall_error_ticks * TURN.si_per_tick  # without load, so it is no stall
    rig.send((0.5, {"turn": 0.2 + off, "slide": 0.05}))
    (told,) = [e for s in rig.run(4.0) for e in s.events if e.kind is not EventKind.STARTED]
    assert told.kind is EventKind.SHORT
    assert "turn" in told.message and "slide" not in told.message


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
    assert EventKind.SLOWED in kinds(steps)
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
    assert EventKind.REPLACED in kinds(steps)
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


def test_broken_off_it_brakes_and_holds_where_it_is(rig: Rig) -> None:
    rig.send((2.0, {"turn": 0.9}))
    rig.run(1.0)
    before = rig.column("turn")
    rig.follower.break_off(EventKind.HELD, "held")
    steps = rig.run(1.0)
    assert kinds(steps) == [EventKind.HELD]
    after = rig.column("turn")[len(before) :]
    assert 0.0 < after[-1] - before[-1] < 0.1
    assert np.all(np.diff(after) >= -1e-12)
    assert steps[-1].goals is not None  # it goes on to hold
    rig.send((1.0, {"turn": 0.0}))
    assert EventKind.ARRIVED in kinds(rig.run(3.0))


def test_a_joint_may_have_a_following_error_of_its_own() -> None:
    rig = Rig()
    joints = dict(rig.config.joints)
    joints["turn"] = TURN.model_copy(update={"max_error": 0.18})
    joints["slide"] = SLIDE.model_copy(update={"max_error": 0.009})
    strict, near = (Rig(CONFIG.model_copy(update={"joints": joints})) for _ in range(2))
    for one, turn in ((rig, 0.4), (strict, 0.4), (near, 0.36)):
        one.obeys.discard(5)
        one.send((1.0, {"turn": turn, "slide": 0.04}))  # 130 ticks of 400 are 0.2 rad
    assert EventKind.FAULT not in kinds(rig.run(4.0))
    assert EventKind.FAULT not in kinds(near.run(4.0))
    (fault,) = [e for s in strict.run(4.0) for e in s.events if e.kind is EventKind.FAULT]
    assert "turn" in fault.message
    near.obeys.discard(9)
    near.send((1.0, {"slide": 0.055}))
    (fault,) = [e for s in near.run(4.0) for e in s.events if e.kind is EventKind.FAULT]
    assert "slide" in fault.message


def test_halt_brakes_and_holds(rig: Rig) -> None:
    rig.send((2.0, {"turn": 0.9}))
    rig.run(1.0)
    before = rig.column("turn")
    rig.follower.accept(JointTrajectory((), ()), rig.now)
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


OMEGA, DAMPING = 2.0 * np.pi * 2.5, 0.02
HALF = np.pi / (OMEGA * np.sqrt(1.0 - DAMPING**2))
LEFT = np.exp(-DAMPING * OMEGA * HALF)  # of a ring after half a period
SHARES = np.array([1.0, 2.0 * LEFT, LEFT**2]) / (1.0 + LEFT) ** 2
PARTS = Shaper(SHARES, HALF * np.arange(3.0), HALF * np.arange(3.0))  # ZVD


def ring_of(rig: Rig, since: int) -> float:
    """What a tip that both joints push sideways still rings by after the trace."""
    q = np.stack([rig.column("turn"), 10.0 * rig.column("slide")], axis=1)[since:]
    one = np.ones((1, 1))
    mode = Modes(np.array([OMEGA]), np.array([[1.0, 0.0, 0.0]]), one, one[0], np.ones((1, 2)))
    where, times = np.zeros(len(q), int), DT * np.arange(len(q))
    return abs(find_amplitudes([mode], where, times, q[..., None], DAMPING, np.ones(1)).item())


def test_a_shaped_move_takes_one_period_more_and_leaves_no_ring() -> None:
    left, took = [], []
    for shapes in (None, lambda way, seconds: PARTS):
        rig = Rig(shapes=shapes)
        rig.send((0.9, {"turn": 0.6, "slide": 0.05}))
        steps = rig.run(2.5)
        assert kinds(steps) == [EventKind.STARTED, EventKind.ARRIVED]
        moving = np.flatnonzero(np.diff(rig.column("turn")) != 0.0)
        took.append(DT * (moving[-1] - moving[0]))
        left.append(ring_of(rig, int(moving[0])))
        assert rig.trace[-1] == pytest.approx({"turn": 0.6, "slide": 0.05})
        assert np.abs(np.diff(rig.column("turn"))).max() <= TURN.max_velocity * DT * (1 + 1e-9)
    assert took[1] - took[0] == pytest.approx(PARTS.duration, abs=2.5 * DT)
    assert left[0] > 0.01 and left[1] < 0.03 * left[0]


def test_what_replaces_a_running_move_is_not_shaped_and_a_hold_brakes_at_once() -> None:
    told = []
    for rig in (Rig(), Rig(shapes=lambda way, seconds: PARTS)):
        rig.send((0.9, {"turn": 0.6}))
        rig.run(0.5)
        rig.send((0.5, {"turn": 0.1}))
        told += [e for s in rig.run(0.06) for e in s.events if e.kind is EventKind.REPLACED]
    assert len(told) == 2 and told[0].message[:12] == told[1].message[:12]
    before = rig.column("turn")
    assert np.abs(np.diff(before, 2)).max() < 0.02  # no jump of speed
    rig.follower.break_off(EventKind.HELD, "held")
    rig.run(0.3)
    assert np.ptp(rig.column("turn")[-4:]) == 0.0


def test_parts_of_a_move_are_kept_out_of_boxes_too() -> None:
    seen: list[np.ndarray] = []

    def keeps_out(q: np.ndarray) -> str:
        seen.append(q)
        return ""

    corner = ((0.9, {"turn": 0.6, "slide": 0.03}), (1.8, {"turn": 0.6, "slide": 0.05}))
    cut = []
    late = np.array([0.0, 0.4])
    for parts in (Shaper(np.ones(1), late[:1], late[:1]), Shaper(np.full(2, 0.5), late, late)):
        rig = Rig(keeps_out=keeps_out, shapes=lambda way, seconds, parts=parts: parts)
        rig.send(*corner)
        rig.run(3.0)
        gone = np.stack([rig.column("turn"), rig.column("slide")], axis=1)
        cut.append(
            [np.hypot(0.6 - q[:, 0], 20.0 * (q[:, 1] - 0.03)).min() for q in (gone, seen[-1])]
        )
    assert cut[1][0] > cut[0][0] + 0.02  # it leaves the path
    assert cut[1][1] == pytest.approx(cut[1][0], abs=0.01)


@pytest.mark.parametrize("late", [0.02, 0.1])
def test_the_joints_come_to_the_end_of_a_run_up_however_late_a_cycle_is(
    rig: Rig, late: float
) -> None:
    """A turn that was passed over left the joint on the other side of its play."""
    rig.send((0.33, {"turn": 0.1, "slide": 0.031}), (0.38, {"turn": 0.12, "slide": 0.032}))
    rig.obeys.discard(5)
    rig.run(0.3)
    for _ in range(3):
        rig.step(dt=late)
        assert rig.column("turn")[-1] >= 0.1
    assert rig.column("turn")[-1] == pytest.approx(0.1)  # it waits there for the joint
    rig.states[5] = replace(rig.states[5], position_ticks=TURN.to_ticks(0.1))
    rig.obeys.add(5)
    assert kinds(rig.run(1.0)) == [EventKind.ARRIVED]
    assert rig.column("turn")[-1] == pytest.approx(0.12)


def test_a_joint_that_does_not_come_to_a_run_up_holds_the_move_up_no_longer_than_a_stall(
    rig: Rig,
) -> None:
    rig.send((0.33, {"turn": 0.1}), (0.66, {"turn": 0.12}))
    rig.obeys.discard(5)
    rig.run(0.36 + LIMITS.stall_time_s - 3 * DT)
    assert rig.column("turn")[-1] == pytest.approx(0.1)
    rig.run(0.66)
    assert rig.column("turn")[-1] == pytest.approx(0.12)


def test_a_path_is_followed_on_time_through_its_turns(rig: Rig) -> None:
    rig.send((0.33, {"turn": 0.1}), (0.66, {"turn": 0.2}), (0.99, {"turn": 0.1}))
    rig.obeys.discard(5)
    rig.run(1.02)
    assert rig.column("turn")[-1] == pytest.approx(0.1)


def test_broken_off_before_the_end_of_a_run_up_it_waits_for_no_joint(rig: Rig) -> None:
    rig.send((0.21, {"turn": 0.1}), (0.4, {"turn": 0.2}))
    rig.obeys.discard(5)
    rig.run(0.2)
    rig.follower.break_off(EventKind.HELD, "held")
    rig.run(LIMITS.blend_s + 2 * DT)
    assert rig.follower.state is FollowerState.HOLDING


def test_a_joint_that_passes_the_end_of_a_run_up_is_not_waited_for(rig: Rig) -> None:
    rig.send((0.33, {"turn": 0.1, "slide": 0.04}), (0.66, {"turn": 0.12, "slide": 0.05}))
    rig.obeys.discard(9)
    rig.run(0.7)
    assert rig.column("turn")[-1] == pytest.approx(0.12)
