"""`trajectory_compensator` between a planner and a controller: one of this test's, and ours."""

import asyncio
import time
from functools import partial
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
from planning import THEIRS, Controller, Planner, ramp
from rclpy.task import Future
from simulated_graph import forked_graph
from small_arm import ARM as SMALL
from small_arm import AWAY
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.planned_path import PathLimits
from longarm_comp.core.data.rest import JOINT_REST
from longarm_comp.core.effects.geometry_errors import DhError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes import trajectory_compensator
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.nodes.clock import stamp_ns
from longarm_comp.nodes.messages import duration

pytestmark = pytest.mark.skipif(not graph.HAS_FOLLOW, reason="control_msgs is not installed")
TYPE = graph.FOLLOW_PLANNED.type


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
    np.testing.assert_allclose(model.tip(went), rigid.tip(plan[1:]), atol=2e-6)
    assert np.linalg.norm(model.tip(plan) - rigid.tip(plan), axis=1).min() > 5e-3
    speeds = np.array([point.velocities for point in sent.points])
    assert 0.1 < np.abs(speeds).max() <= 0.5 + 1e-6 and not speeds[-1].any()

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
    goal = planner.send(names, plan[::-1])
    stage.spin(lambda: len(controller.got) == 5)
    controller.server.destroy()
    assert f"{THEIRS} is gone" in planner.ends(goal, aborted).error_string


def test_an_arm_that_droops_does_not_dip_where_a_path_begins(stage: Bench, arm: Arm) -> None:
    """Its servos yield below their set-points: what the encoders read is sent nowhere."""
    controller = Controller(stage, arm)
    stage.start("trajectory_compensator", {
        "arm": ARM, "controller": THEIRS, "acknowledged": False, "method": "deflection",
        "max_velocity": [1.0], "max_acceleration": [5.0], "planned_period_s": 0.05,
        "diagnostics_period_s": 0.1,
    })  # fmt: skip
    planned, seen = stage.collect(graph.PLANNED_JOINTS), stage.collect(graph.JOINT_STATES)
    planner, names, done = Planner(stage), list(arm.joint_names), GoalStatus.STATUS_SUCCEEDED
    up = np.where(arm.slides, 0.0, 0.1)
    ends = [arm.mid + up, arm.mid + 2.0 * up]
    planner.ends(planner.send(names, ramp(arm.mid, ends[0])), done)
    controller.droop = 0.15 * up  # more than a step of the next plan
    stage.spin(
        lambda: seen and np.allclose(seen[-1].position, controller.walk.q - controller.droop)
    )
    del planned[:]
    stage.spin(lambda: len(planned) > 2)
    np.testing.assert_allclose(
        Model(arm).tip(np.array(planned[-1].position)), Model(arm).tip(ends[0]), atol=2e-6
    )
    first = controller.walk.q
    planner.ends(planner.send(names, ramp(np.array(planned[-1].position), ends[1])), done)
    points = controller.got[-1].trajectory.points
    sent = np.array([point.positions for point in points])
    assert np.diff(sent, axis=0, prepend=first[None]).min() > -1e-6
    assert len(sent) == 10 and points[-1].time_from_start == duration(1.0)  # no step to take up
    said = planner.ends(planner.send(names, np.array(planned[-1].position)[None]), done)
    assert "nothing was sent" in said.error_string and len(controller.got) == 2


@pytest.mark.parametrize(
    ("steps", "tries", "words"),
    [
        ([0.5 * JOINT_REST], 1, ""),
        ([1.5 * JOINT_REST, 0.0], 2, ""),
        (np.tile(1.5 * JOINT_REST, 9), trajectory_compensator._TRIES, "elbow moved by 0.003"),
    ],
)
def test_a_path_is_sent_only_from_where_the_arm_still_stands(
    steps: list[float], tries: int, words: str
) -> None:
    """``steps``: by how much the arm moves while the path is computed each time, rad."""
    kind, left = trajectory_compensator._TrajectoryCompensator, list(steps)
    state, begun = SimpleNamespace(joints=np.zeros(2)), list[np.ndarray]()
    node: Any = SimpleNamespace(
        _state=state, _arm=SimpleNamespace(joint_names=("base", "elbow")),
        _not_now=lambda asked, sent_s: "",
        _compensate_request=lambda request, stood: (stood, ""),
    )  # fmt: skip
    node._describe_motion = partial(kind._describe_motion, node)

    async def compute(job: Any) -> Any:
        begun.append(state.joints)
        state.joints = state.joints + np.array([0.0, left.pop(0)])
        return job()

    node._worker = SimpleNamespace(ask=compute)

    def told() -> Any:
        with pytest.raises(StopIteration) as ended:
            kind._compute_path(node, SimpleNamespace(trajectory=None), 7.0).send(None)
        return ended.value.value

    made, why = told()
    assert len(begun) == tries and words in why and bool(words) == bool(why)
    assert made is (None if words else begun[-1])
    left[:] = [0.0]
    node._not_now = lambda asked, sent_s: f"stopped after {sent_s:g} s"
    assert told() == (None, "stopped after 7 s")


@pytest.mark.parametrize("accepted", [False, True])
@pytest.mark.parametrize("next_one", [set(), {b"restarted"}])
def test_a_goal_ends_when_its_controller_is_gone_and_is_cancelled_if_it_is_accepted_late(
    accepted: bool, next_one: set[bytes]
) -> None:
    """It is gone before it accepts, or after it; perhaps another one is there at once."""
    kind, said, cancels = trajectory_compensator._TrajectoryCompensator, list[str](), list[int]()
    sent = SimpleNamespace(
        accepted=True, get_result_async=Future, cancel_goal_async=lambda: cancels.append(1)
    )
    goal: Any = SimpleNamespace(
        request=TYPE.Goal(), is_cancel_requested=False, abort=lambda: said.append("aborted")
    )
    sending, seen = Future(), [{b"first"}, {b"first"}]
    timed = SimpleNamespace(
        joints=np.zeros((2, 1)), times=np.arange(2.0), velocities=np.zeros((2, 1))
    )
    node: Any = SimpleNamespace(
        _arm=SimpleNamespace(joint_names=("base",)), _stamps=SimpleNamespace(next=Time),
        _out=SimpleNamespace(send_goal_async=lambda goal, feedback: sending),
        _driver=SimpleNamespace(acknowledged=True, forget_history=lambda: said.append("forgotten")),
        _ticks=SimpleNamespace(next=lambda: asyncio.sleep(0)), _controller="theirs",
        _controllers=lambda: seen.pop(0) if seen else next_one,
        tally=SimpleNamespace(count=lambda what, why: said.append(why)),
    )  # fmt: skip
    node._hear, node._give_up = partial(kind._hear, node), partial(kind._give_up, node)
    if accepted:
        sending.set_result(sent)
    result = asyncio.run(
        asyncio.wait_for(kind._forward_path(node, goal, SimpleNamespace(timed=timed)), 10.0)
    )
    assert "theirs is gone" in result.error_string
    assert said[0] == "forgotten" and said[-1] == "aborted"
    assert len(cancels) == accepted
    if not accepted:
        sending.set_result(sent)
        assert len(cancels) == 1


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
    np.testing.assert_allclose([p.positions for p in sent], goes[1:], atol=1e-6)
    assert np.abs([p.velocities for p in sent]).max() < 0.5
    assert sent[-1].time_from_start == duration(2.0)
    far = goes[-1] + np.outer(np.linspace(0.0, 1.0, 21), [4.0, 0, 0, 0, 0, 0])
    stage.spin(lambda: controller.walk.q[0] > 3.2)
    goal = planner.send(names, wrapped(far), 20.0)
    if endless:
        planner.ends(goal, GoalStatus.STATUS_SUCCEEDED)
        sent = controller.got[-1].trajectory.points
        np.testing.assert_allclose([p.positions for p in sent], far[1:], atol=1e-6)
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
    np.testing.assert_allclose(bent.tip(went), rigid.tip(plan[1:]), atol=2e-6)

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

        def seen() -> bool:  # the planner sees where the arm was sent, finer than a servo's step
            return np.allclose(Model(arm).tip(np.array(planned[-1].position)), wanted, atol=2e-6)

        stage.spin(seen)
