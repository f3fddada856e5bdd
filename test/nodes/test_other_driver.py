"""An arm that another program drives: `longarm up --no-driver`, its status, and servos that give
way without a driver that says what was reached."""

import signal
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from cli_shell import Shell
from nodes_bench import Bench
from small_arm import ARM
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.reduced_speed import times_at_reduced_speed
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.nodes.messages import joints_message, pose_message, seconds


def arm_file(folder: Path) -> Path:
    file = folder / "arm.yaml"
    file.write_text(ARM.model_dump_json(exclude_defaults=True))
    return file


def test_the_graph_comes_up_without_a_driver_and_its_status_asks_for_none(
    stage: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stage.node.create_publisher(graph.DRIVER_STATE.type, "servo_driver/state", 1)  # the other one's
    joints = graph.JOINT_STATES.publisher(stage.node)
    stage.node.create_timer(0.05, lambda: joints.publish(
        joints_message(ARM, ARM.mid, stage.node.get_clock().now().to_msg())
    ))  # fmt: skip
    up = stage.python(["-m", "longarm_comp", "up", str(arm_file(tmp_path)), "--no-driver"])
    said = stage.collect(graph.DIAGNOSTICS)
    ready = "compensating", "no error_predictor answers: physics only"
    stage.spin(lambda: any(
        s.name.endswith("kinematics: targets") and s.message in ready
        for m in said for s in m.status
    ))  # fmt: skip
    # Its controller may know no limits: a long way is not asked for at once
    sent = stage.collect(graph.JOINT_TRAJECTORY)
    far = Model(ARM).pose(ARM.upper - 0.02 * (ARM.upper - ARM.lower))
    targets = graph.TARGET_POSE.publisher(stage.node)
    ask = graph.TARGET_POSE.type(pose=pose_message(far))
    ask.header.frame_id = "base"
    stage.spin(lambda: sent or targets.publish(ask))
    (last,) = sent[-1].points[-1:]
    ways = [p.positions for p in sent[-1].points]
    due = times_at_reduced_speed(Model(ARM), ARM.mid, np.array(ways), 0.5)
    assert seconds(last.time_from_start) == pytest.approx(due[-1], rel=0.1)
    assert due[-1] > 0.6 and list(last.velocities) == [0.0] * ARM.n
    shell, both = Shell(tmp_path, capsys), ["error_predictor", "kinematics"]
    # it tells the nodes that it has discovered, which may be one
    found = stage.spin(
        lambda: next((s for s in [shell.json("status")] if s["nodes"] == both), None)
    )
    assert found["next"] == "" and "another program drives the arm" in found["why"]
    up.send_signal(signal.SIGINT)
    stage.spin(lambda: up.poll() is not None)
    assert "Traceback" not in stage.output(up)


def test_what_only_our_driver_knows_is_refused_without_it(tmp_path: Path) -> None:
    arm = arm_file(tmp_path)
    for given in ({"sim": True}, {"port": "/dev/ttyUSB0"}, {"shaping": True}):
        with pytest.raises(InputError, match="without the driver"):
            BringUp(arm=arm, driver=False, **given)
    for side in ("left", "right"):
        (tmp_path / "cameras").mkdir(exist_ok=True)
        (tmp_path / "cameras" / f"{side}.yaml").write_text("")
    assert "stereo_bridge" in BringUp(arm=arm, driver=False).nodes


@pytest.mark.parametrize(
    ("off", "words"),
    [
        ([0.0, 0.006, 0.0, 0.0], "joint2 is 0.006 rad off, allowed 0.002: servos that give way "
         "need --within 0.009"),
        ([0.0, 0.003, 0.004, 0.0], "joint3 is 0.004 m off, allowed 0.002"),
        ([0.5, 0.0, 0.0, 0.0], "joint1 is 0.5 rad off, allowed 0.002: does its driver hear"),
    ],
)  # fmt: skip
def test_a_joint_short_of_its_command_is_named_with_its_gap_and_what_helps(
    ros_domain: int, off: list[float], words: str
) -> None:
    """A driver that tells nothing but joint_states, and whose servos droop."""
    with ArmClient(ARM) as client:
        joints = graph.JOINT_STATES.publisher(client.node)
        stands = joints_message(ARM, ARM.mid - off)
        client.node.create_timer(0.02, lambda: joints.publish(stands))
        path, pace = ARM.mid[None], Pace(arrive_s=0.5, dwell_s=0.1)
        with pytest.raises(JobError, match=words):
            client.arrive(path, pace)
        if max(off) < 0.01:
            client.arrive(path, Pace(dwell_s=0.1, tolerance=0.009))


@pytest.mark.parametrize("ours", [False, True])
def test_a_session_asks_only_our_driver_for_a_long_way_at_once(ros_domain: int, ours: bool) -> None:
    """Our driver keeps limits of speed; of another's controller nobody knows any."""
    with ArmClient(ARM) as client:
        joints, sent = graph.JOINT_STATES.publisher(client.node), list[JointTrajectory]()
        graph.JOINT_TRAJECTORY.subscription(client.node, sent.append)
        if ours:
            driver = graph.DRIVER_STATE.publisher(client.node)
            client.until(lambda: client.node.count_publishers(driver.topic_name), 60.0, "driver")
        else:
            with pytest.raises(JobError, match="no joint_states"):
                client.send(ARM.upper[None])
        client.node.create_timer(0.02, lambda: joints.publish(joints_message(ARM, ARM.lower)))
        client.until(lambda: client.joints is not None, 60.0, "joints")
        path = np.array([ARM.mid, ARM.upper])
        client.until(lambda: sent or (client.send(path, 0.5, 0.1) and False), 60.0, "a trajectory")
        due = [seconds(point.time_from_start) for point in sent[0].points]
        slow = times_at_reduced_speed(Model(ARM), ARM.lower, path, 0.5, 0.1)
        assert due == pytest.approx([0.5, 1.0] if ours else slow)
        assert slow[-1] > 2.0


def test_a_joint_that_moves_within_a_wide_tolerance_is_not_at_rest(ros_domain: int) -> None:
    with ArmClient(ARM) as client:
        joints, way = graph.JOINT_STATES.publisher(client.node), np.linspace(-0.05, 0.05, 30)
        swings = iter([*way, *way[::-1]] * 100)

        def tell() -> None:
            joints.publish(joints_message(ARM, ARM.mid + next(swings)))

        client.node.create_timer(0.02, tell)
        with pytest.raises(JobError, match="does not stay"):
            client.arrive(ARM.mid[None], Pace(arrive_s=0.6, dwell_s=0.2, tolerance=0.1))
