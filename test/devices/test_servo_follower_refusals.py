"""Trajectories that the follower refuses, and states in which it takes none."""

import math
from typing import Any

import pytest
from follower_rig import CONFIG, TURN, Rig, kinds, servo_state

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.follower_report import EventKind
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint
from longarm_comp.devices.servo_follower import TrajectoryFollower


@pytest.fixture
def rig() -> Rig:
    return Rig()


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
        (_points((1.0, (0.1, 0.01)), (2.0, (-1.1, 0.01))), "points[1].positions of turn"),
        (_points((1.0, (0.1, 0.01)), (2.0, (1.1, 0.01))), "points[1].positions of turn"),
        (_points((1.0, (0.1, 0.01)), (2.0, (0.1,))), "points[1].positions"),
        (_points((1.0, (0.1, 0.01)), (2.0, (math.nan, 0.01))), "points[1].positions of turn"),
        (_points((1.0, (0.1, -0.01))), "0 to 0.1 m"),
        (_points((-1.0, (0.1, 0.01))), "points[0].time_from_start"),
        (_points((math.nan, (0.1, 0.01))), "points[0].time_from_start"),
        (_points((1.0, (0.1, 0.01)), (1.0, (0.2, 0.01))), "points[1].time_from_start"),
        (
            JointTrajectory(
                ("turn",), (TrajectoryPoint(1.0, (0.1,), (0.0,)), TrajectoryPoint(2.0, (0.1,)))
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
        (_points(*((0.01 * k, (0.1, 0.01)) for k in range(1, 1002))), "1000 at most"),
        (_points(*((0.01 * k, (0.1, 0.01)) for k in range(1002))), "1000 at most"),
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


@pytest.mark.parametrize("first", [0, 1])
def test_a_thousand_points_are_taken_with_and_without_the_start(rig: Rig, first: int) -> None:
    """`trajectory_compensator` adds the start to a plan that begins after it."""
    rig.follower.accept(_points(*((0.1 * k, (0.1, 0.01)) for k in range(first, 1001))), rig.now)


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize("name", ["turn", "slide"])
def test_an_order_beyond_a_limit_is_refused_not_clipped(rig: Rig, name: str, end: int) -> None:
    """Half a tick beyond is the limit itself: no servo can tell them apart."""
    joint = CONFIG.joints[name]
    limit, outward = (joint.lower, joint.upper)[end], (-1.0, 1.0)[end] * joint.si_per_tick
    for ticks in (0.55, 1.0, 20.0, 4096.0):
        with pytest.raises(InputError, match=f"of {name}: "):
            rig.send((1.0, {name: limit + ticks * outward}))
        with pytest.raises(InputError, match="position: "):
            joint.to_ticks(limit + ticks * outward)
    rig.send((1.0, {name: limit + 0.45 * outward}))
    steps = rig.run(3.0)
    goals = steps[-1].goals
    assert kinds(steps) == [EventKind.STARTED, EventKind.ARRIVED]
    assert goals is not None and goals[joint.servo_id] in joint.tick_limits
    assert joint.to_si(goals[joint.servo_id]) == pytest.approx(limit, abs=joint.si_per_tick)


def test_nothing_is_taken_before_every_servo_was_heard() -> None:
    follower = TrajectoryFollower(CONFIG)
    target = _points((1.0, (0.1, 0.01)))
    with pytest.raises(JobError, match="fresh reading"):
        follower.accept(target, 0.0)
    follower.step(0.0, {5: servo_state(2048)})
    with pytest.raises(JobError, match="fresh reading"):
        follower.accept(target, 0.0)
    follower.step(0.02, {5: servo_state(2048), 9: servo_state(3900)})
    with pytest.raises(JobError, match="fresh reading"):
        follower.accept(target, 5.0)
    with pytest.raises(JobError, match="fresh reading"):
        follower.accept(JointTrajectory((), ()), 5.0)  # to stop, where nothing moves
    follower.accept(target, 0.02)


def test_an_arm_outside_its_limits_or_too_hot_is_not_moved(rig: Rig) -> None:
    rig.states[5] = servo_state(TURN.to_ticks(1.0) + 200)
    rig.run(0.1)
    with pytest.raises(InputError, match="by hand"):
        rig.send((1.0, {"turn": 0.0}))
    rig.states[5] = servo_state(2048, temperature_c=80.0)
    rig.run(0.1)
    with pytest.raises(JobError, match="overheated"):
        rig.send((1.0, {"turn": 0.0}))
