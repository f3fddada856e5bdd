"""`kinematics` and `error_predictor` as processes on a real graph."""

import math
import signal
from pathlib import Path

import numpy as np
import pytest
import yaml
from places import ROOT

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from geometry_msgs.msg import PoseWithCovarianceStamped
from nodes_bench import Bench
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu, Temperature
from std_srvs.srv import Trigger
from target_requests import pose, request
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects import catalogue
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.slow_changes import ThermalGrowth
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import joints_message
from longarm_comp.nodes.orders import order_id
from longarm_interfaces.msg import Compensation
from longarm_interfaces.srv import Compensate


def test_target_pose_becomes_a_trajectory(stage: Bench, arm: Arm, demo_arm_path: Path) -> None:
    stage.start("kinematics", {"arm": demo_arm_path})
    trajectories = stage.collect(graph.JOINT_TRAJECTORY)
    stories = stage.collect(graph.COMPENSATION)
    targets = graph.TARGET_POSE.publisher(stage.node)
    joints = graph.JOINT_STATES.publisher(stage.node)
    stage.connected(targets)
    stage.connected(joints)
    model = declared_model(arm)
    target = model.pose(arm.mid + 0.02)

    def told_of_what_was_sent() -> list[Compensation]:
        """Published again and again: what comes before both sides are matched is lost."""
        joints.publish(joints_message(arm, arm.mid))
        targets.publish(pose(target))
        sent = {order_id(trajectory) for trajectory in trajectories}
        return [story for story in stories if story.executed.position and story.id in sent]

    story, *_ = stage.spin(told_of_what_was_sent)
    trajectory = next(t for t in trajectories if order_id(t) == story.id)
    assert story.status == Compensate.Response.NO_PREDICTOR
    assert "physics only" in story.message
    assert list(trajectory.joint_names) == list(arm.joint_names)
    assert trajectory.header.frame_id == ""  # joints have no frame, and it holds no id
    sent = np.array(trajectory.points[0].positions)
    np.testing.assert_allclose(model.pose(sent), target, atol=2e-6)
    assert list(story.executed.position) == sent.tolist()


def test_an_effect_of_a_file_is_compensated(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalogue, "_others", {})  # the node's process knows of the file alone
    example = ROOT / "examples" / "custom_effect.py"
    (kind,) = catalogue.load_file(example)
    model = declared_model(arm).plus(kind(joint=5, driver=2, gain=0.03))
    save_model(tmp_path / "model.yaml", store(model))
    files = {"arm": demo_arm_path, "model": tmp_path / "model.yaml"}
    stage.start("kinematics", files, words=("--effects", str(example)))
    target = model.pose(arm.mid + 0.02)
    client = graph.COMPENSATE.client(stage.node)
    answer = stage.call(client, request(target, arm))
    assert answer.status == Compensate.Response.NO_PREDICTOR
    np.testing.assert_allclose(model.pose(np.array(answer.command.position)), target, atol=2e-6)
    assert np.linalg.norm(declared_model(arm).tip(arm.mid + 0.02) - target[:3, 3]) > 1e-3


def test_of_a_burst_every_target_and_request_is_answered_once(
    stage: Bench, arm: Arm, demo_arm_path: Path
) -> None:
    """More than may wait: the rest is refused in words, nothing is lost on the way."""
    stage.start("kinematics", {"arm": demo_arm_path, "queue": 40, "method": "deflection"})
    trajectories = stage.collect(graph.JOINT_TRAJECTORY)
    stories = stage.collect(graph.COMPENSATION)
    targets = graph.TARGET_POSE.publisher(stage.node)
    client = graph.COMPENSATE.client(stage.node)
    stage.connected(targets)
    model, seed = declared_model(arm), joints_message(arm, arm.mid)
    asked = [pose(model.pose(arm.mid + 0.02 * math.sin(i))) for i in range(150)]
    first = Compensate.Request(target=asked[0], seed=seed)
    stage.spin(lambda: stage.call(client, first).success and stories)
    futures = [client.call_async(Compensate.Request(target=t, seed=seed)) for t in asked]
    stage.spin(lambda: all(f.done() for f in futures))
    answers = {f.result().id: f.result().status for f in futures}
    assert len(answers) == len(asked)
    assert {Compensate.Response.SUCCESS, Compensate.Response.NOT_READY} == set(answers.values())
    stage.spin(lambda: answers.keys() <= {s.id for s in stories})
    burst = [(s.id, s.status) for s in stories if s.id in answers]
    assert sorted(burst) == sorted(answers.items())

    joints = graph.JOINT_STATES.publisher(stage.node)
    stage.connected(joints)
    joints.publish(seed)

    def heard() -> bool:
        joints.publish(seed)
        return bool(stage.call(client, Compensate.Request(target=asked[0])).success)

    stage.spin(heard)
    others = graph.TARGET_POSE.publisher(stage.node)
    for publisher in (targets, others):
        stage.matched(publisher, pose(model.pose(arm.mid)), stories)
    del stories[:]
    for i in range(1, 1001):
        target = asked[i % len(asked)]
        target.header.stamp.nanosec = i  # a name; 0 s is within the age, as the clock is the test's
        target.header.stamp.sec = int(stage.node.get_clock().now().nanoseconds // 10**9)
        (targets, others)[i % 2].publish(target)
    told = lambda: [s for s in stories if 0 < s.target.header.stamp.nanosec <= 1000]  # noqa: E731
    stage.spin(lambda: len(told()) >= 1000)
    names = [story.target.header.stamp.nanosec for story in told()]
    assert sorted(names) == list(range(1, 1001))
    sent = [s for s in told() if s.status == Compensate.Response.SUCCESS]
    others_told = {s.status for s in told()} - {Compensate.Response.SUCCESS}
    assert others_told == {Compensate.Response.SUPERSEDED}
    assert all(s.message for s in told() if s.status != Compensate.Response.SUCCESS)
    assert sent[-1].target.header.stamp.nanosec >= 999  # the last of either publisher
    ids = sorted(story.id for story in sent)
    stage.spin(lambda: sorted({order_id(t) for t in trajectories} & set(ids)) == ids)


def test_every_refusal_has_a_status_and_a_reason(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path
) -> None:
    aside = np.where(np.arange(arm.n) == 0, 0.9 * arm.upper + 0.1 * arm.lower, arm.mid)
    lamp = declared_model(arm).tip(aside)
    box = {"min_m": (lamp - 0.01).tolist(), "max_m": (lamp + 0.01).tolist()}
    declared = dict(read_yaml(demo_arm_path)) | {"keep_out": {"lamp": box}}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(declared))
    node = stage.start("kinematics", {"arm": tmp_path / "arm.yaml"})
    trajectories = stage.collect(graph.JOINT_TRAJECTORY)
    stories = stage.collect(graph.COMPENSATION)
    client = graph.COMPENSATE.client(stage.node)
    reach = declared_model(arm).pose(arm.mid)
    status = Compensate.Response

    answers: list[Compensate.Response] = []

    def call(asked: Compensate.Request) -> Compensate.Response:
        answers.append(stage.call(client, asked))
        return answers[-1]

    def ask(matrix: np.ndarray, **more: object) -> Compensate.Response:
        return call(request(matrix, arm, execute=True, **more))

    setter = stage.node.create_client(SetParameters, "kinematics/set_parameters")
    for value, fits in (("rubbish", False), ("deflection", True), ("both", True)):
        asked = Parameter("method", value=value).to_parameter_msg()
        answered = stage.call(setter, SetParameters.Request(parameters=[asked]))
        assert answered.results[0].successful == fits
        assert fits or "one of none, deflection" in answered.results[0].reason
    joints = graph.JOINT_STATES.publisher(stage.node)
    stage.connected(joints)
    unseeded = Compensate.Request(target=pose(reach), execute=True)
    assert stage.call(client, unseeded).status == status.NOT_READY
    assert ask(reach).status == status.NOT_READY  # a seed does not say where the arm stands

    def stands(q: np.ndarray, words: str, age_s: float = 0.0) -> None:
        """Tell joints until an executed target is refused with these words; "": it is not."""
        now = stage.node.get_clock().now() - Duration(seconds=age_s)

        def heard() -> bool:
            joints.publish(joints_message(arm, arm.mid))
            joints.publish(joints_message(arm, q, now.to_msg() if age_s else None))
            answer = ask(reach)
            refused = answer.status == status.NOT_READY
            return refused == bool(words) and words in answer.message

        stage.spin(heard)

    stands(np.where(np.arange(arm.n) == 3, 50.0, arm.mid), "joint4: 50")
    stands(arm.mid + 0.8 * (arm.upper - arm.mid), "jumped")
    stands(arm.mid, " s old", age_s=100.0)
    stands(arm.mid, "")
    stage.spin(lambda: trajectories)
    stage.spin(lambda: stories and stories[-1].executed.position)
    del trajectories[:], answers[:]
    lost = reach.copy()
    lost[0, 3] = math.nan
    assert ask(lost).status == status.BAD_TARGET
    lost[0, 3] = math.inf
    assert ask(lost, position_only=True).status == status.BAD_TARGET
    stranger = Compensate.Request(target=pose(reach, "kitchen"), seed=joints_message(arm, arm.mid))
    answer = call(stranger)
    assert answer.status == status.BAD_FRAME
    assert "kitchen" in answer.message
    bent = request(reach, arm, execute=True)
    bent.target.pose.orientation.w += 0.1
    assert call(bent).status == status.BAD_TARGET
    foreign = request(reach, arm, execute=True)
    foreign.seed.name[0] = "elbow"
    answer = call(foreign)
    assert answer.status == status.BAD_TARGET
    assert "elbow" in answer.message
    answer = ask(declared_model(arm).pose(aside))
    assert answer.status == status.KEPT_OUT
    assert "keep_out lamp: the arm would enter it near" in answer.message
    wild = request(reach, arm)
    wild.seed.position[2] = 50.0
    answer = call(wild)
    assert answer.status == status.BAD_TARGET
    assert "joint3: 50" in answer.message
    for age_s, words in ((100.0, " s old"), (-100.0, "in the future")):
        old = request(reach, arm, execute=True)
        then = stage.node.get_clock().now() - Duration(seconds=age_s)
        old.target.header.stamp = then.to_msg()
        answer = call(old)
        assert answer.status == status.STALE_TARGET
        assert words in answer.message
    far = reach.copy()
    far[0, 3] += 3.0
    answer = call(request(far, arm, execute=True, position_only=True))
    assert answer.status == status.UNREACHABLE
    assert not answer.command.position
    assert not trajectories
    refused = {answer.id for answer in answers}
    stage.spin(lambda: refused <= {story.id for story in stories})
    told = [story for story in stories if story.id in refused]
    assert len(told) == len(answers) == 10
    assert all(story.message and not story.executed.position for story in told)

    quiet = ask(reach)
    assert quiet.status == status.NO_PREDICTOR
    assert quiet.success
    stage.spin(lambda: trajectories)
    node.send_signal(signal.SIGINT)
    assert node.wait(timeout=300) == 0


def test_a_new_model_is_taken_up_without_a_restart(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path
) -> None:
    path = tmp_path / "model.yaml"
    stage.start("kinematics", {"arm": demo_arm_path, "model": path, "watch_period_s": 0.1})
    stories = stage.collect(graph.COMPENSATION)
    client = graph.COMPENSATE.client(stage.node)
    model = declared_model(arm)
    target = model.pose(arm.mid)
    before = stage.call(client, request(target, arm))
    reload = graph.RELOAD.client(stage.node, of="kinematics")
    path.write_text("effects: 3")  # the declared arm does not take its place
    assert not stage.call(reload, Trigger.Request()).success
    refused = stage.call(client, request(target, arm))
    assert refused.status == Compensate.Response.NOT_READY
    assert str(path) in refused.message and not refused.command.position
    shifted = model.plus(*(z.with_values({"offset": 0.01}) for z in JointZero.for_arm(arm)[:1]))
    save_model(path, store(shifted))

    def taken_up() -> bool:
        stage.call(client, request(target, arm))
        return bool(stories and stories[-1].model_hash)

    stage.spin(taken_up)
    after = stage.call(client, request(target, arm))
    np.testing.assert_allclose(shifted.pose(np.array(after.ideal.position)), target, atol=2e-6)
    assert abs(after.ideal.position[0] - before.ideal.position[0]) > 0.005

    path.write_text("effects: 3")
    answer = stage.call(reload, Trigger.Request())
    assert not answer.success
    assert str(path) in answer.message
    kept = stage.call(client, request(target, arm))
    np.testing.assert_allclose(kept.ideal.position, after.ideal.position, atol=1e-9)


def test_what_the_model_needs_must_be_told_and_nonsense_is_only_counted(
    stage: Bench, arm: Arm, demo_arm_path: Path, tmp_path: Path
) -> None:
    path = tmp_path / "model.yaml"
    warm = declared_model(arm).plus(ThermalGrowth(8e-5))
    save_model(path, store(warm))
    files = {"arm": demo_arm_path, "model": path}
    node = stage.start("kinematics", {**files, "diagnostics_period_s": 0.1})
    client = graph.COMPENSATE.client(stage.node)
    stories = stage.collect(graph.COMPENSATION)
    diagnostics = stage.collect(graph.DIAGNOSTICS)
    target = warm.pose(arm.mid, Context(columns={"temperature_c": 40.0}))
    answer = stage.call(client, request(target, arm))
    assert answer.status == Compensate.Response.STALE_CONTEXT
    assert "temperature_c was never published" in answer.message

    topics = (graph.JOINT_STATES, graph.JOINT_TRAJECTORY, graph.TEMPERATURE, graph.INCLINATION)
    joints, trajectories, temperatures, tilts = (t.publisher(stage.node) for t in topics)
    tips = graph.TIP_MEASURED.publisher(stage.node)
    for publisher in (joints, trajectories, temperatures, tilts, tips):
        stage.connected(publisher)
    nonsense = joints_message(arm, np.full(arm.n, math.nan))
    lonely = joints_message(arm, arm.mid)
    lonely.name = lonely.name[:1]

    def all_counted() -> bool:
        """Best effort: sent until each has been heard."""
        joints.publish(nonsense)
        joints.publish(lonely)
        trajectories.publish(JointTrajectory(joint_names=["elbow"]))
        temperatures.publish(Temperature(temperature=math.nan))
        tilts.publish(Imu(orientation_covariance=[-1.0] + [0.0] * 8))
        tips.publish(PoseWithCovarianceStamped())
        facts = {
            value.key for array in diagnostics for status in array.status for value in status.values
        }
        return {f"bad {topic.name}" for topic in topics} <= facts

    stage.spin(all_counted)

    def told() -> bool:
        temperatures.publish(Temperature(temperature=40.0))
        answer = stage.call(client, request(target, arm))
        return answer.status == Compensate.Response.NO_PREDICTOR

    stage.spin(told)
    stage.spin(lambda: stories and stories[-1].temperature_c == 40.0)
    np.testing.assert_allclose(stories[-1].ideal.position, arm.mid, atol=1e-3)
    assert node.poll() is None
