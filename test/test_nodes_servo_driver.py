"""`servo_driver` as a process, on an emulated bus that the test holds in its hands."""

from __future__ import annotations

import math
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration, Time
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nodes_bench import Bench, bench, own_graph
from rcl_interfaces.srv import DescribeParameters
from rclpy.action import ActionClient
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import duration
from longarm_comp.sim.servo_emulator import MotorSpec, ServoEmulator, read_arm
from longarm_interfaces.msg import DriverState, Motion

CONFIG = """
/**/servo_driver:
  ros__parameters:
    retry_s: 0.2
    diagnostics_period_s: 0.1
    bus: {protocol: feetech, port: PORT, reply_timeout_s: 0.2, retries: 1}
    joints:
      shoulder: {servo_id: 1, model: sts3215, type: revolute, zero_ticks: 2048.0, gear_ratio: 3.0,
        multi_turn: true, lower: -0.5, upper: 1.0, max_velocity: 2.0,
        full_effort: 8.0}
      boom: {servo_id: 2, model: sts3215, type: prismatic, zero_ticks: 3900.0, direction: -1,
        pinion_radius_m: 0.018, lower: 0.0, upper: 0.1, max_velocity: 0.1}
    follower: {stall_time_s: 0.3, silence_s: 1.0}
"""


class Rig:
    """An emulated bus, the driver's process, and what it says."""

    def __init__(self, stage: Bench, folder: Path) -> None:
        self.stage = stage
        self.file = folder / "servo_driver.yaml"
        self.link = folder / "bus"
        self.file.write_text(CONFIG.replace("PORT", str(self.link)))
        self.arm = read_arm(self.file)
        self.emulator = ServoEmulator(
            self.arm.protocol,
            self.arm.start_ticks(),
            MotorSpec(stiff_ticks=30.0),
            link=self.link,
        )
        self.emulator.start()
        self.states = stage.collect(graph.JOINT_STATES)
        self.motions = stage.collect(graph.MOTION)
        self.said = stage.collect(graph.DRIVER_STATE)
        self.diagnostics = stage.collect(graph.DIAGNOSTICS)
        self.trajectories = graph.JOINT_TRAJECTORY.publisher(stage.node)
        self.process = self.start()

    def start(self, patience_s: float = 5.0, clock: str = "system") -> subprocess.Popen[str]:
        command = ["-m", "longarm_comp.nodes.servo_driver", "--ros-args"]
        command += ["--params-file", str(self.file), "-p", f"patience_s:={patience_s}"]
        if clock == "nobody's":  # /clock is waited for, and never comes
            command += ["-p", "use_sim_time:=true"]
        self.process = self.stage.python(command)
        return self.process

    def begins_without_servos(self, patience_s: float) -> subprocess.Popen[str]:
        """End the driver and start it anew with no cable."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(timeout=10) == 0
        self.emulator.unplug()
        del self.diagnostics[:]
        return self.start(patience_s)

    def driving(self) -> bool:
        return all(self.emulator.torques_on().values())

    def free(self) -> bool:
        return not any(self.emulator.torques_on().values())

    def joints(self) -> dict[str, float]:
        """Where the emulated joints really stand."""
        return self.arm.values(self.emulator.positions())

    def send(self, name: str = "", **goal: float) -> None:
        point = JointTrajectoryPoint(
            positions=list(goal.values()), time_from_start=Duration(nanosec=200_000_000)
        )
        self.stage.connected(self.trajectories)
        self.trajectories.publish(
            JointTrajectory(header=Header(frame_id=name), joint_names=list(goal), points=[point])
        )

    def events(self, name: str) -> list[int]:
        """What the driver has told of the trajectory of that id."""
        return [motion.event for motion in self.motions if motion.id == name]

    def becomes(self, name: str, *events: int) -> Motion:
        """Wait until this, and nothing else, has become of a trajectory; the last message."""
        self.stage.spin(lambda: len(self.events(name)) >= len(events))
        assert self.events(name) == list(events)
        return next(motion for motion in reversed(self.motions) if motion.id == name)

    def is_in(self, state: int) -> DriverState:
        """Wait until the driver tells that state."""
        self.stage.spin(lambda: self.said and self.said[-1].state == state)
        return self.said[-1]

    def arrives(self, **goal: float) -> None:
        def there() -> bool:
            at = self.joints()
            return all(abs(at[name] - value) < 1e-3 for name, value in goal.items())

        self.stage.spin(there)

    def goes(self, **goal: float) -> None:
        """Send until it is on its way: the driver's subscription may still be connecting."""
        self.send(**goal)
        self.arrives(**goal)

    def told(self, part: str) -> str:
        """The last sentence of a part of /diagnostics."""
        for array in reversed(self.diagnostics):
            for status in array.status:
                if status.name.endswith(part):
                    return str(status.message)
        return ""

    def refused(self) -> int:
        """How many trajectories it says it refused."""
        for array in reversed(self.diagnostics):
            for status in array.status:
                for value in status.values:
                    if value.key == "refused":
                        return int(value.value)
        return -1

    def call(self, service: graph.Service, request: Any) -> Any:
        return self.stage.call(service.client(self.stage.node, of="servo_driver"), request)

    def change(self, transition: int) -> bool:
        client = self.stage.node.create_client(ChangeState, "servo_driver/change_state")
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.stage.call(client, request).success)

    def is_idle(self) -> None:
        """Wait until it drives and has read every servo."""
        self.stage.spin(lambda: self.driving() and self.told(": arm") in ("idle", "holding"))


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("driver")
    with own_graph(folder), bench() as stage:
        made = Rig(stage, folder)
        try:
            yield made
        finally:
            stage.end_processes()
            made.emulator.stop()


@pytest.fixture
def rig(shared: Rig) -> Rig:
    """The driver, running and in order; started again where a test ended it."""
    del shared.diagnostics[:], shared.motions[:]
    if shared.process.poll() is not None:
        shared.start()
    shared.is_idle()
    return shared


def test_follows_reports_and_lets_go_through_its_life(rig: Rig) -> None:
    rig.send("there", shoulder=0.4)
    rig.becomes("there", Motion.ACCEPTED, Motion.REACHED)
    accepted = next(motion for motion in rig.motions if motion.event == Motion.ACCEPTED)
    assert list(accepted.start.name) == ["shoulder", "boom"]
    (point,) = accepted.points  # of every joint, also of the one that it does not name
    assert point.positions == pytest.approx([0.4, accepted.start.position[1]])
    rig.goes(boom=0.05)
    last = rig.stage.spin(
        lambda: (
            rig.states
            and np.allclose(rig.states[-1].position, [0.4, 0.05], atol=1e-3)
            and rig.states[-1]
        )
    )
    assert list(last.name) == ["shoulder", "boom"]
    assert abs(last.effort[0]) <= 8.0 and math.isnan(last.effort[1])  # full effort: not told

    assert rig.change(Transition.TRANSITION_DEACTIVATE)
    assert rig.free()
    rig.send("asleep", shoulder=0.0)
    assert "not active" in rig.becomes("asleep", Motion.REFUSED).message
    assert "torque is off" in rig.is_in(DriverState.INACTIVE).message
    assert rig.joints()["shoulder"] == pytest.approx(0.4, abs=1e-3)
    assert rig.change(Transition.TRANSITION_ACTIVATE)
    assert rig.driving()
    assert rig.joints()["shoulder"] == pytest.approx(0.4, abs=1e-3)
    rig.is_idle()
    rig.goes(shoulder=0.1)
    assert rig.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert rig.free()
    rig.process.send_signal(signal.SIGINT)
    assert rig.process.wait(timeout=10) == 0
    assert "ended" in rig.is_in(DriverState.UNCONFIGURED).message


def test_bad_trajectories_move_nothing_and_are_counted(rig: Rig) -> None:
    before, already = rig.joints(), rig.refused()
    bad = (
        {"elbow": 0.1},
        {"shoulder": 2.0},
        {"shoulder": float("nan")},
        {"boom": -0.01},
    )
    for goal in bad:
        rig.send("bad", **goal)
    rig.trajectories.publish(JointTrajectory(joint_names=["boom"], points=[JointTrajectoryPoint()]))

    rig.stage.spin(lambda: rig.refused() == already + len(bad) + 1)
    rig.becomes("bad", *[Motion.REFUSED] * len(bad))
    assert "elbow" in next(motion for motion in rig.motions if motion.id == "bad").message
    assert rig.joints() == pytest.approx(before, abs=1e-5)
    rig.goes(boom=0.02)


def test_emergency_stop_lets_go_until_it_is_released(rig: Rig) -> None:
    rig.send("first", shoulder=1.0)
    rig.stage.spin(lambda: rig.joints()["shoulder"] > 0.05)
    rig.is_in(DriverState.MOVING)
    rig.send("second", shoulder=1.0)
    rig.becomes("first", Motion.ACCEPTED, Motion.REPLACED)
    assert rig.call(graph.ESTOP, SetBool.Request(data=True)).success
    assert rig.free()
    assert "emergency stop" in rig.becomes("second", Motion.ACCEPTED, Motion.BROKEN_OFF).message
    rig.is_in(DriverState.ESTOP)
    stopped = rig.joints()["shoulder"]
    assert stopped < 0.95
    rig.send(shoulder=0.0)
    rig.stage.spin(lambda: rig.told(": arm").startswith("emergency stop"))
    assert rig.joints()["shoulder"] == stopped
    assert rig.call(graph.ESTOP, SetBool.Request(data=False)).success
    assert rig.driving()
    rig.is_idle()
    rig.goes(shoulder=0.0)


def test_held_it_stays_under_torque_and_takes_nothing(rig: Rig) -> None:
    rig.send("away", shoulder=0.9)
    rig.stage.spin(lambda: rig.joints()["shoulder"] > 0.05)
    assert rig.call(graph.HOLD, SetBool.Request(data=True)).success
    rig.becomes("away", Motion.ACCEPTED, Motion.BROKEN_OFF)
    rig.is_in(DriverState.HOLDING)
    rig.send("refused", shoulder=0.0)
    assert "~/hold" in rig.becomes("refused", Motion.REFUSED).message
    assert rig.driving()
    assert 0.05 < rig.joints()["shoulder"] < 0.85
    assert rig.call(graph.HOLD, SetBool.Request(data=False)).success
    rig.is_in(DriverState.READY)
    rig.goes(shoulder=0.0)
    assert rig.events("away") == [Motion.ACCEPTED, Motion.BROKEN_OFF]


def test_a_stalled_servo_stops_the_arm_until_reset(rig: Rig) -> None:
    rig.emulator.block(1)
    rig.send("blocked", shoulder=0.8, boom=0.05)
    rig.stage.spin(lambda: "shoulder" in rig.told(": arm"))
    assert "shoulder" in rig.becomes("blocked", Motion.ACCEPTED, Motion.BROKEN_OFF).message
    assert "shoulder" in rig.is_in(DriverState.FAULT).message
    rig.emulator.block(1, False)
    assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_idle()
    rig.goes(shoulder=0.2)


def test_an_unplugged_cable_is_told_and_taken_up_again(rig: Rig) -> None:
    rig.emulator.unplug()
    rig.stage.spin(lambda: "unplugged" in rig.told("servo bus"))
    rig.emulator.replug()
    rig.stage.spin(lambda: rig.told("servo bus") == "every servo answers")
    if "idle" not in rig.told(": arm"):
        assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_idle()
    rig.goes(boom=0.03)


def test_servos_that_come_after_the_driver_are_no_error(rig: Rig) -> None:
    process = rig.begins_without_servos(patience_s=60.0)
    rig.stage.spin(lambda: "not usable" in rig.told("servo bus"))
    rig.emulator.replug()
    rig.is_idle()
    said = rig.stage.output(process)
    assert "ERROR" not in said
    assert "WARN" not in said
    assert "waiting for the servos" in said


def test_servos_that_stay_away_are_an_error(rig: Rig) -> None:
    process = rig.begins_without_servos(patience_s=0.0)
    rig.stage.spin(lambda: "ERROR" in rig.stage.output(process))
    rig.emulator.replug()
    rig.is_idle()


@pytest.mark.parametrize("signals", [[signal.SIGINT] * 2, [signal.SIGTERM]])
def test_a_signal_lets_the_servos_go(rig: Rig, signals: list[signal.Signals]) -> None:
    for number in signals:
        rig.process.send_signal(number)
    assert rig.process.wait(timeout=10) == 0
    assert rig.free()


def test_a_killed_driver_leaves_the_arm_standing_and_its_successor_needs_no_clock(rig: Rig) -> None:
    rig.goes(shoulder=0.3)
    rig.process.kill()
    rig.process.wait(timeout=10)
    assert rig.driving()  # the arm does not drop
    del rig.diagnostics[:], rig.states[:]
    rig.start(clock="nobody's")
    rig.is_idle()
    assert rig.joints()["shoulder"] == pytest.approx(0.3, abs=1e-3)
    rig.send("timeless", shoulder=0.1)
    rig.becomes("timeless", Motion.ACCEPTED, Motion.REACHED)
    assert rig.states[-1].header.stamp == Time()  # the node's clock stands at 0
    rig.arrives(shoulder=0.1)
    clocks = rig.stage.node.create_publisher(Clock, "/clock", 10)
    for second in (50, 1000, 2):  # it runs away, and jumps back
        del rig.states[:]

        def at(second: int = second) -> bool:
            clocks.publish(Clock(clock=Time(sec=second)))
            return bool(rig.states) and rig.states[-1].header.stamp.sec == second

        rig.stage.spin(at)
        rig.goes(shoulder=0.0 if second == 50 else 1e-4 * second)
    rig.process.send_signal(signal.SIGINT)
    assert rig.process.wait(timeout=10) == 0


def test_parameters_are_described_and_wrong_ones_refused(rig: Rig, tmp_path: Path) -> None:
    client = rig.stage.node.create_client(DescribeParameters, "servo_driver/describe_parameters")
    names = ["rate_hz", "joints.boom.lower", "bus.retries"]
    described = rig.stage.call(client, DescribeParameters.Request(names=names)).descriptors
    assert all(d.description and d.read_only for d in described)
    assert described[0].floating_point_range[0].to_value == 500.0
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(rig.file.read_text().replace("gear_ratio", "gear_ration"))
    second = rig.stage.python(
        ["-m", "longarm_comp.nodes.servo_driver", "--ros-args", "--params-file", str(wrong)]
    )
    assert second.wait(timeout=60) == 2
    said = rig.stage.output(second)
    assert "gear_ration" in said
    assert "gear_ratio" in said
    assert "Traceback" not in said


def test_steps_that_the_servos_do_not_have_are_refused(rig: Rig, tmp_path: Path) -> None:
    arm = tmp_path / "arm.yaml"
    shoulder = {"id": 1, "name": "shoulder", "type": "revolute", "limits_deg": [-28, 57]}
    shoulder["step_deg"] = 0.36
    tip = {"frame": 1, "position_m": [1, 0, 0]}
    text = {"name": "arm", "convention": "mdh_craig", "tip": tip, "joints": [shoulder]}
    arm.write_text(yaml.safe_dump(text))
    second = rig.stage.python(
        [
            *("-m", "longarm_comp.nodes.servo_driver", "--ros-args"),
            *("--params-file", str(rig.file), "-p", f"arm:={arm}"),
        ]
    )
    assert second.wait(timeout=60) == 2
    said = rig.stage.output(second)
    assert "step of shoulder" in said
    assert "whole multiples of the servo's tick" in said
    assert "Traceback" not in said


needs_follow = pytest.mark.skipif(
    not graph.HAS_FOLLOW, reason="control_msgs is not installed: run make setup"
)


class Followed:
    """A goal of `follow_joint_trajectory`, its feedback and what became of it."""

    def __init__(self, rig: Rig, times: float = 0.2, tolerances: dict[str, Any] | None = None,
                 **to: float) -> None:  # fmt: skip
        self.rig, self.feedback = rig, []
        self.client = ActionClient(rig.stage.node, graph.FOLLOW.type, graph.FOLLOW.name)
        rig.stage.spin(self.client.server_is_ready)
        point = JointTrajectoryPoint(positions=list(to.values()))
        point.time_from_start = duration(times)
        goal = graph.FOLLOW.type.Goal(**(tolerances or {}))
        goal.trajectory = JointTrajectory(joint_names=list(to), points=[point])
        sent = self.client.send_goal_async(goal, lambda said: self.feedback.append(said.feedback))
        rig.stage.spin(sent.done)
        self.goal = sent.result()
        assert self.goal.accepted
        self.result = self.goal.get_result_async()

    def ends(self, status: int, code: int) -> str:
        """Wait for the end; what it says."""
        self.rig.stage.spin(self.result.done)
        got = self.result.result()
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
    followed = Followed(rig, 0.6, {"goal_tolerance": allowed("shoulder", 0.05)},
                        shoulder=0.6, boom=0.02)  # fmt: skip
    assert followed.ends(GoalStatus.STATUS_SUCCEEDED, codes.SUCCESSFUL) == ""
    assert rig.joints()["shoulder"] == pytest.approx(0.6, abs=3e-3)
    said = followed.feedback
    assert list(said[-1].joint_names) == ["shoulder", "boom"]
    for one in said:
        off = one.desired.positions[0] - one.actual.positions[0]
        assert one.error.positions[0] == pytest.approx(off, abs=1e-12)
        assert min(start, 0.6) - 0.01 < one.desired.positions[0] < max(start, 0.6) + 0.01
    # The same story is told on the topic, by an id of its own.
    (name,) = {motion.id for motion in rig.motions}
    rig.becomes(name, Motion.ACCEPTED, Motion.REACHED)


@needs_follow
@pytest.mark.parametrize(
    ("to", "tolerances", "code", "words"),
    [
        ({"elbow": 0.1}, {}, "INVALID_JOINTS", "'elbow'; allowed: one of shoulder, boom"),
        ({"shoulder": 3.0}, {}, "INVALID_GOAL", "shoulder"),
        ({"shoulder": 0.1}, {"velocity": 1.0}, "INVALID_GOAL", "velocity or acceleration"),
    ],
)
def test_a_goal_that_cannot_be_followed_is_refused_in_words(
    rig: Rig, to: dict[str, float], tolerances: dict[str, float], code: str, words: str
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
