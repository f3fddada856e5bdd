"""The driver's action `follow_joint_trajectory`, on an emulated bus."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from driver_rig import Rig
from lifecycle_msgs.msg import Transition
from nodes_bench import bench
from own_graph import own_graph
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import duration
from longarm_comp.nodes.orders import FollowServer
from longarm_interfaces.msg import Motion

needs_follow = pytest.mark.skipif(
    not graph.HAS_FOLLOW, reason="control_msgs is not installed: run make setup"
)


class Followed:
    """A goal of `follow_joint_trajectory`, its feedback and what became of it."""

    def __init__(self, rig: Rig, times: float = 0.2, tolerances: dict[str, Any] | None = None,
                 **to: float) -> None:  # fmt: skip
        self.rig, self.feedback = rig, []
        self.client = rig.stage.action(graph.FOLLOW.type, graph.FOLLOW.name)
        point = JointTrajectoryPoint(positions=list(to.values()))
        point.time_from_start = duration(times)
        goal = graph.FOLLOW.type.Goal(**(tolerances or {}))
        goal.trajectory = JointTrajectory(joint_names=list(to), points=[point])
        self.asked = goal
        self._send()

    def _send(self) -> None:
        sent = self.client.send_goal_async(
            self.asked, lambda said: self.feedback.append(said.feedback)
        )
        self.rig.stage.spin(sent.done)
        self.goal = sent.result()
        assert self.goal.accepted
        self.result = self.goal.get_result_async()

    def ends(self, status: int, code: int) -> str:
        """Wait for the end; what it says.

        A driver that had no processor time refuses what may be old, or may have been sent before it
        went on; then it is asked again.
        """
        self.rig.stage.spin(self.result.done)
        old = "this node was away", "the order was sent before the arm was stopped, or went on"
        while any(why in (got := self.result.result()).result.error_string for why in old):
            self._send()
            self.rig.stage.spin(self.result.done)
        assert (got.status, got.result.error_code) == (status, code), got.result.error_string
        self.client.destroy()
        return str(got.result.error_string)


def allowed(name: str, position: float) -> list[Any]:
    from control_msgs.msg import JointTolerance

    return [JointTolerance(name=name, position=position)]


@needs_follow
def test_a_goal_of_joints_is_followed_told_of_and_reached(rig: Rig) -> None:
    rig.is_idle()
    codes = graph.FOLLOW.type.Result
    start = rig.joints()["shoulder"]
    given = {"goal_tolerance": allowed("shoulder", 0.05), "goal_time_tolerance": Duration(sec=-1)}
    followed = Followed(rig, 0.6, given, shoulder=0.6, boom=0.02)
    assert followed.ends(GoalStatus.STATUS_SUCCEEDED, codes.SUCCESSFUL) == ""
    assert rig.joints()["shoulder"] == pytest.approx(0.6, abs=3e-3)
    said = followed.feedback
    assert list(said[-1].joint_names) == ["shoulder", "boom"]
    for one in said:
        off = one.desired.positions[0] - one.actual.positions[0]
        assert one.error.positions[0] == pytest.approx(off, abs=1e-12)
        assert min(start, 0.6) - 0.01 < one.desired.positions[0] < max(start, 0.6) + 0.01
    # The same story is told on the topic, by an id of its own.
    rig.becomes(rig.motions[-1].id, Motion.ACCEPTED, Motion.REACHED)


@needs_follow
@pytest.mark.parametrize(
    ("to", "tolerances", "code", "words"),
    [
        ({"elbow": 0.1}, {}, "INVALID_JOINTS", "'elbow'; allowed: one of shoulder, boom"),
        ({"shoulder": 3.0}, {}, "INVALID_GOAL", "shoulder"),
        ({"shoulder": 0.1}, {"velocity": 1.0}, "INVALID_GOAL", "velocity or acceleration"),
        (
            {"shoulder": 0.1},
            {"name": "Shoulder"},
            "INVALID_GOAL",
            "path_tolerance: 'Shoulder'; allowed: one of shoulder, boom",
        ),
        ({"shoulder": 0.1}, {"position": math.nan}, "INVALID_GOAL", "shoulder: position nan"),
        ({"shoulder": 0.1}, {"velocity": math.nan}, "INVALID_GOAL", "shoulder: velocity nan"),
    ],
)
def test_a_goal_that_cannot_be_followed_is_refused_in_words(
    rig: Rig, to: dict[str, float], tolerances: dict[str, Any], code: str, words: str
) -> None:
    rig.is_idle()
    limits = allowed("shoulder", 0.1)
    for name, value in tolerances.items():
        setattr(limits[0], name, value)
    before = rig.joints()
    followed = Followed(rig, tolerances={"path_tolerance": limits}, **to)
    code_number = getattr(graph.FOLLOW.type.Result, code)
    assert words in followed.ends(GoalStatus.STATUS_ABORTED, code_number)
    assert rig.joints() == pytest.approx(before, abs=1e-3)


class PlayedDriver:
    """It accepts what moves, and says of an order to stop what it is set to."""

    names, readings, set_points, following = ("shoulder",), {}, {}, ""

    def __init__(self, event: int) -> None:
        self.event, self.server = event, None

    def take(self, message: JointTrajectory, name: str) -> None:
        self.server.on_event(Motion.ACCEPTED if message.points else self.event, name, "so")


@needs_follow
@pytest.mark.parametrize(
    ("event", "said"),
    [
        (Motion.REACHED, "the arm was stopped"),
        (Motion.REPLACED, "the arm was not stopped as asked: so"),
        (Motion.REFUSED, "the arm was not stopped as asked: so"),
        (Motion.BROKEN_OFF, "the arm was not stopped as asked: so"),
    ],
)
def test_a_goal_that_ends_early_calls_an_arm_stopped_only_at_rest(
    tmp_path: Path, event: int, said: str
) -> None:
    codes = graph.FOLLOW.type.Result
    with own_graph(tmp_path), bench() as stage:
        site = PlayedDriver(event)
        site.server = FollowServer(stage.node, site)
        cancelled = Followed(SimpleNamespace(stage=stage), 20.0, shoulder=0.5)
        cancelled.goal.cancel_goal_async()
        end = cancelled.ends(GoalStatus.STATUS_CANCELED, codes.SUCCESSFUL)
        assert end == f"cancelled: {said}"
        given = {"goal_time_tolerance": duration(0.01)}
        late = Followed(SimpleNamespace(stage=stage), 0.01, given, shoulder=0.5)
        end = late.ends(GoalStatus.STATUS_ABORTED, codes.GOAL_TOLERANCE_VIOLATED)
        assert end == f"not at the end within goal_time_tolerance: {said}"


@needs_follow
def test_a_goal_that_is_not_reached_says_why(rig: Rig) -> None:
    """Replaced, cancelled, too late, beyond its tolerance, broken off."""
    rig.is_idle()
    codes, aborted = graph.FOLLOW.type.Result, GoalStatus.STATUS_ABORTED
    rig.goes(shoulder=0.0)
    slow = Followed(rig, 20.0, shoulder=0.9)
    rig.stage.spin(lambda: slow.feedback)
    rig.send("topic", shoulder=0.1)
    assert "another trajectory" in slow.ends(aborted, codes.PATH_TOLERANCE_VIOLATED)
    rig.arrives(shoulder=0.1)
    slow = Followed(rig, 20.0, shoulder=0.9)
    rig.stage.spin(lambda: slow.feedback)
    slow.goal.cancel_goal_async()
    assert "the arm was stopped" in slow.ends(GoalStatus.STATUS_CANCELED, codes.SUCCESSFUL)
    assert rig.joints()["shoulder"] < 0.5
    late = Followed(rig, 0.05, {"goal_time_tolerance": duration(0.05)}, shoulder=1.0)
    assert "goal_time_tolerance" in late.ends(aborted, codes.GOAL_TOLERANCE_VIOLATED)
    rough = Followed(rig, 0.3, {"path_tolerance": allowed("shoulder", 1e-5)}, shoulder=0.0)
    assert "off on the way, 1e-05 allowed" in rough.ends(aborted, codes.PATH_TOLERANCE_VIOLATED)
    assert rig.joints()["shoulder"] > 0.05  # stopped before its end
    slow = Followed(rig, 20.0, shoulder=-0.4)
    rig.stage.spin(lambda: slow.feedback)
    assert rig.call(graph.ESTOP, SetBool.Request(data=True)).success
    assert "emergency stop" in slow.ends(aborted, codes.PATH_TOLERANCE_VIOLATED)
    assert rig.call(graph.ESTOP, SetBool.Request(data=False)).success


@needs_follow
def test_a_goal_ends_when_the_driver_is_shut_down(rig: Rig) -> None:
    rig.is_idle()
    rig.goes(shoulder=0.0)
    slow = Followed(rig, 20.0, shoulder=0.9)
    rig.stage.spin(lambda: slow.feedback)
    assert rig.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    code = graph.FOLLOW.type.Result.PATH_TOLERANCE_VIOLATED
    assert slow.ends(GoalStatus.STATUS_ABORTED, code) == "torque off"
    rig.ends()
