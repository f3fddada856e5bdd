"""`trajectory_compensator` between a planner and a controller: one of this test's, and ours."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from cobot import declared, through_pi, wrapped
from control_msgs.msg import JointComponentTolerance
from geometry_msgs.msg import PointStamped
from nodes_bench import Bench
from places import DEMO_ARM as ARM
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from simulated_graph import forked_graph
from small_arm import ARM as SMALL
from small_arm import AWAY
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from walking import Walk

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.planned_path import PathLimits
from longarm_comp.core.effects.geometry_errors import DhError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes import trajectory_compensator
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.nodes.clock import Ticks, stamp_ns
from longarm_comp.nodes.messages import duration, joints_message

pytestmark = pytest.mark.skipif(not graph.HAS_FOLLOW, reason="control_msgs is not installed")
TYPE = graph.FOLLOW_PLANNED.type
THEIRS = "arm_controller/follow_joint_trajectory"


class Controller:
    """A joint trajectory controller that goes where it is sent to, and ends as it is told to."""

    def __init__(self, stage: Bench, arm: Arm) -> None:
        self.arm, self.got, self.walk = arm, [], Walk(arm)
        self.ends, self.waits = GoalStatus.STATUS_SUCCEEDED, False
        self.node, self.ticks = stage.node, Ticks(stage.node, 0.02)
        self.joints = graph.JOINT_STATES.publisher(stage.node)
        self.timer = stage.node.create_timer(0.05, self.tell)
        self.server = ActionServer(
            stage.node, TYPE, THEIRS, self.serve, callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )  # fmt: skip

    def tell(self) -> None:
        self.walk.step()
        now = self.node.get_clock().now().to_msg()
        self.joints.publish(joints_message(self.arm, self.walk.q, now))

    async def serve(self, goal: Any) -> Any:
        self.got.append(goal.request)
        goal.publish_feedback(TYPE.Feedback(joint_names=["fed back"]))
        self.walk.go(point.positions for point in goal.request.trajectory.points)
        while (self.waits or self.walk.ahead) and not goal.is_cancel_requested:
            await self.ticks.next()
        if goal.is_cancel_requested:
            self.walk.ahead.clear()
            goal.canceled()
            return TYPE.Result(error_string="halted by the controller")
        if self.ends == GoalStatus.STATUS_SUCCEEDED:
            goal.succeed()
            return TYPE.Result()
        goal.abort()
        return TYPE.Result(error_code=TYPE.Result.PATH_TOLERANCE_VIOLATED, error_string="off")


class Planner:
    """Plans in joints of the declared arm and sends it to `follow_joint_trajectory`."""

    def __init__(self, stage: Bench) -> None:
        self.stage, self.fed, self.health = stage, [], stage.collect(graph.DIAGNOSTICS)
        self.client = stage.action(TYPE, graph.FOLLOW_PLANNED.name)
        stage.spin(self.ready)

    def ready(self) -> bool:
        """Whether the node says so: everything is compiled."""
        parts = [s for array in self.health for s in array.status if s.name.endswith(": paths")]
        return bool(parts) and parts[-1].message == "ready"

    def send(
        self, names: list[str], path: np.ndarray, seconds: float = 1.0, *,
        stamp: Time | None = None, **more: Any,
    ) -> Any:  # fmt: skip
        times = np.linspace(0.0, seconds, len(path))
        points = [
            JointTrajectoryPoint(positions=q, time_from_start=duration(t))
            for t, q in zip(times.tolist(), path.tolist(), strict=True)
        ]
        trajectory = JointTrajectory(joint_names=names, points=points)
        trajectory.header.stamp = stamp or Time()
        sent = self.client.send_goal_async(
            TYPE.Goal(trajectory=trajectory, **more), lambda m: self.fed.append(m.feedback)
        )
        self.stage.spin(sent.done)
        assert sent.result().accepted
        return sent.result()

    def ends(self, goal: Any, status: int) -> Any:
        """Wait for a goal's end, and check it; its result."""
        result = goal.get_result_async()
        self.stage.spin(result.done)
        assert result.result().status == status, result.result().result.error_string
        return result.result().result


def ramp(start: np.ndarray, end: np.ndarray, count: int = 11) -> np.ndarray:
    share = np.linspace(0.0, 1.0, count)[:, None]
    return start + (3 * share**2 - 2 * share**3) * (end - start)


def test_a_goal_is_no_later_than_its_time_tolerance_and_the_parameter_allow() -> None:
    end = JointTrajectoryPoint(time_from_start=duration(4.0))
    for given, late_s, share in (
        (1.0, 0.0, 1.0),
        (1.0, 2.0, 0.5),
        (0.1, 2.0, 0.1),
        (0.0, 2.0, 0.0),
    ):
        goal = TYPE.Goal(
            trajectory=JointTrajectory(points=[end]), goal_time_tolerance=duration(late_s)
        )
        node: Any = SimpleNamespace(_limits=PathLimits(max_longer=given))
        assert trajectory_compensator._TrajectoryCompensator._longest_share(node, goal) == share


def test_a_plan_goes_compensated_to_any_controller_or_is_refused_before_anything_moves(
    stage: Bench, arm: Arm
) -> None:
    controller = Controller(stage, arm)
    velocity = 0.5 * np.ones(arm.n)
    stage.start("trajectory_compensator", {
        "arm": ARM, "controller": THEIRS, "acknowledged": False, "method": "deflection",
        "max_velocity": velocity.tolist(), "max_acceleration": [5.0], "planned_period_s": 0.05,
        "diagnostics_period_s": 0.1,
    })  # fmt: skip
    planned = stage.collect(graph.PLANNED_JOINTS)
    planner, names = Planner(stage), list(arm.joint_names)
    end = arm.mid + 0.2 * (arm.upper - arm.lower)
    stage.spin(lambda: planned)  # it knows the joints
    plan = ramp(arm.mid, end)
    hard = [JointComponentTolerance(joint_name=names[0])]
    further = {"goal_time_tolerance": duration(3.0), "component_path_tolerance": hard}
    goal = planner.send(names[::-1], plan[:, ::-1], **further)
    planner.ends(goal, GoalStatus.STATUS_SUCCEEDED)
    (got,) = controller.got
    assert planner.fed[-1].joint_names == ["fed back"]
    assert got.goal_time_tolerance == duration(3.0)
    assert got.component_path_tolerance == hard  # the controller decides of what it cannot do
    sent, names_sent = got.trajectory, list(got.trajectory.joint_names)
    assert abs(stamp_ns(sent.header.stamp) - time.time_ns()) < 60e9 and names_sent == names
    assert sent.header.frame_id == ""
    went = np.array([point.positions for point in sent.points])
    model, rigid = declared_model(arm), Model(arm)
    np.testing.assert_allclose(went[0], arm.mid, atol=1e-9)
    np.testing.assert_allclose(model.tip(went[1:]), rigid.tip(plan[1:]), atol=2e-6)
    assert np.linalg.norm(model.tip(plan) - rigid.tip(plan), axis=1).min() > 5e-3
    speeds = np.array([point.velocities for point in sent.points])
    assert 0.1 < np.abs(speeds).max() <= 0.5 + 1e-6 and not speeds[[0, -1]].any()

    def seen() -> bool:  # the planner sees its own end, not the servos'
        found = np.array(planned[-1].position)
        return np.allclose(rigid.pose(found), rigid.pose(end), atol=2e-6) and (
            np.abs(found - end).max() < 1e-3 < np.abs(found - went[-1]).max()
        )

    stage.spin(seen)
    back = planner.send([names[1]], ramp(end[1:2], arm.mid[1:2]))  # the others stay
    planner.ends(back, GoalStatus.STATUS_SUCCEEDED)
    assert len(controller.got) == 2 and len(controller.got[-1].trajectory.joint_names) == arm.n

    stands = np.where(np.arange(arm.n) == 1, arm.mid, end)
    plan, aborted, old = ramp(stands, arm.mid), GoalStatus.STATUS_ABORTED, Time(sec=1)
    for given, words, code in (
        ({"names": ["elbow", *names[1:]]}, "elbow", TYPE.Result.INVALID_JOINTS),
        ({"path": ramp(stands, arm.upper)}, "way-point", TYPE.Result.INVALID_GOAL),
        ({"path": plan + 0.3}, "from where the plan begins", TYPE.Result.INVALID_GOAL),
        ({"path": plan[:0]}, "without points", TYPE.Result.INVALID_GOAL),
        ({"path": np.full_like(plan, np.nan)}, "finite", TYPE.Result.INVALID_GOAL),
        ({"stamp": old}, "s old", TYPE.Result.INVALID_GOAL),
    ):
        result = planner.ends(planner.send(**({"names": names, "path": plan} | given)), aborted)
        assert words in result.error_string and result.error_code == code
    assert len(controller.got) == 2

    learned = graph.LEARNED.publisher(stage.node)
    learned.publish(String(data="/nowhere/model.at_work.json"))

    def refused(why: str) -> bool:
        return why in planner.ends(planner.send(names, plan + 0.3), aborted).error_string

    stage.spin(lambda: refused("what kinematics learned at work"))
    learned.publish(String())
    stage.spin(lambda: refused("from where the plan begins"))

    controller.ends = aborted
    result = planner.ends(planner.send(names, plan), aborted)
    assert result.error_code == TYPE.Result.PATH_TOLERANCE_VIOLATED and result.error_string == "off"
    controller.waits = True
    goal = planner.send(names, plan[::-1])
    stage.spin(lambda: len(controller.got) == 4)
    goal.cancel_goal_async()
    assert "halted" in planner.ends(goal, GoalStatus.STATUS_CANCELED).error_string


@pytest.mark.parametrize("endless", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_plan_through_pi_goes_on_live_or_is_refused(
    stage: Bench, tmp_path: Path, endless: bool
) -> None:
    """A planner wraps angles into -pi..pi; the controller gets them as the joint goes on."""
    file = tmp_path / "arm.yaml"
    on_and_on = {1: {"endless": True, "limits_deg": None}}
    file.write_text(yaml.safe_dump(declared(180.0, on_and_on) if endless else declared(360.0)))
    made, (goes, said) = Arm.load(file), through_pi()
    controller = Controller(stage, made)
    controller.walk.q = goes[0]
    stage.start("trajectory_compensator", {
        "arm": file, "controller": THEIRS, "acknowledged": False, "method": "deflection",
        "max_velocity": [1.0], "max_acceleration": [5.0], "planned_period_s": 0.05,
        "diagnostics_period_s": 0.1,
    })  # fmt: skip
    planner, names = Planner(stage), list(made.joint_names)
    planner.ends(planner.send(names, said, 2.0), GoalStatus.STATUS_SUCCEEDED)
    sent = controller.got[-1].trajectory.points
    np.testing.assert_allclose([p.positions for p in sent], goes, atol=1e-6)
    assert np.abs([p.velocities for p in sent]).max() < 0.5
    assert sent[-1].time_from_start == duration(2.0)
    far = goes[-1] + np.outer(np.linspace(0.0, 1.0, 21), [4.0, 0, 0, 0, 0, 0])
    stage.spin(lambda: controller.walk.q[0] > 3.2)
    goal = planner.send(names, wrapped(far), 20.0)
    if endless:
        planner.ends(goal, GoalStatus.STATUS_SUCCEEDED)
        sent = controller.got[-1].trajectory.points
        np.testing.assert_allclose([p.positions for p in sent], far, atol=1e-6)
        return
    result = planner.ends(goal, GoalStatus.STATUS_ABORTED)
    assert "way-point 16: bad_target: joint1 from" in result.error_string
    assert len(controller.got) == 1


@pytest.mark.parametrize(
    ("free", "tracked"),
    [
        pytest.param(False, False, marks=pytest.mark.long),
        pytest.param(True, False, marks=pytest.mark.long),
        (False, True),
    ],
)
def test_an_arm_that_cannot_hold_the_orientation_follows_a_plan_and_says_so(
    stage: Bench, tmp_path: Path, free: bool, tracked: bool
) -> None:
    """Four joints, a tool that leans: no joints bring both its place and its orientation.

    ``tracked``: the model's frame is a tracker's, metres away and turned; the plan is in the base.
    """
    files = {"arm": tmp_path / "arm.yaml", "model": tmp_path / "model.yaml"}
    files["arm"].write_text(yaml.safe_dump(SMALL.model_dump(mode="json", exclude_none=True)))
    made = Arm.load(files["arm"])
    bent = Model(made, (DhError(row=2, alpha=0.02), DhError(row=4, alpha=0.03)))
    save_model(files["model"], store(bent.plus(AWAY) if tracked else bent))
    controller = Controller(stage, made)
    stage.start("trajectory_compensator", {
        **files, "controller": THEIRS, "acknowledged": False, "method": "deflection",
        "max_velocity": [1.0], "max_acceleration": [5.0], "planned_period_s": 0.05,
        "diagnostics_period_s": 0.1, "position_only": free,
    })  # fmt: skip
    planned = stage.collect(graph.PLANNED_JOINTS)
    planner, plan = Planner(stage), ramp(made.mid, made.mid + 0.2 * (made.upper - made.lower))
    goal = planner.send(list(made.joint_names), plan, 2.0)
    said = planner.ends(goal, GoalStatus.STATUS_SUCCEEDED).error_string
    assert ("the joints cannot hold the orientation: it is off by up to" in said) is not free
    went = np.array([point.positions for point in controller.got[-1].trajectory.points])
    rigid = Model(made)
    np.testing.assert_allclose(bent.tip(went[1:]), rigid.tip(plan[1:]), atol=2e-6)

    def seen() -> bool:  # the planner sees its own end
        found = rigid.tip(np.array(planned[-1].position))
        return np.allclose(found, rigid.tip(plan[-1]), atol=2e-6)

    stage.spin(seen)


def test_without_limits_nothing_goes_to_a_controller_that_is_not_ours(stage: Bench) -> None:
    node = stage.start("trajectory_compensator", {"arm": ARM, "acknowledged": False})
    assert node.wait(timeout=300) == 2
    assert "max_velocity" in stage.output(node) and "Traceback" not in stage.output(node)


def test_through_our_driver_the_true_tip_ends_where_the_plan_meant_it(
    stage: Bench, arm: Arm
) -> None:
    up = BringUp(
        arm=ARM, sim=True, speed=5.0, without=("stereo_bridge", "kinematics", "error_predictor"),
        set={"simulated_arm": {"frame_rate_hz": 4.0}},
    )  # fmt: skip
    tips: list[PointStamped] = []
    stage.node.create_subscription(PointStamped, "simulated_arm/true_tip", tips.append, 10)
    joints = stage.collect(graph.JOINT_STATES)
    with forked_graph(up):
        stage.start("trajectory_compensator", {"arm": ARM, "method": "deflection"})
        planner, states = Planner(stage), stage.collect(graph.DRIVER_STATE)
        planned = stage.collect(graph.PLANNED_JOINTS)
        stage.spin(lambda: planned and states and states[-1].state == states[-1].READY)
        start = np.array(planned[-1].position)
        end = arm.mid + 0.2 * (arm.upper - arm.lower)
        goal = planner.send(list(arm.joint_names), ramp(start, end, 21), 2.0)
        planner.ends(goal, GoalStatus.STATUS_SUCCEEDED)
        del tips[:], joints[:]
        stage.spin(lambda: len(tips) > 3 and joints)
        at = tips[-1].point
        wanted = Model(arm).tip(end)
        missed = np.linalg.norm(np.array([at.x, at.y, at.z]) - wanted)
        assert np.linalg.norm(declared_model(arm).tip(end) - wanted) > 5e-3
        assert missed < 5e-4  # steps of the servos, and what the rods differ by
