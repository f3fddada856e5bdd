"""`servo_driver` as a process, on an emulated bus that the test holds in its hands."""

import math
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from builtin_interfaces.msg import Time
from driver_rig import Rig
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters, ListParameters
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import Health
from longarm_comp.nodes.params import ROS_OWN
from longarm_comp.nodes.servo_driver import reporting_faults
from longarm_interfaces.msg import DriverState, Motion


def refusal(rig: Rig, *words: str) -> str:
    """What a driver says that ends for bad input."""
    second = rig.stage.python(["-m", "longarm_comp.nodes.servo_driver", "--ros-args", *words])
    assert second.wait(timeout=300) == 2
    said = rig.stage.output(second)
    assert "Traceback" not in said
    return said


def test_follows_reports_and_lets_go_through_its_life(rig: Rig) -> None:
    rig.send("there", shoulder=0.4)
    rig.becomes("there", Motion.ACCEPTED, Motion.REACHED)
    accepted = next(motion for motion in rig.motions if motion.event == Motion.ACCEPTED)
    assert list(accepted.start.name) == ["shoulder", "boom"]
    (point,) = accepted.points  # of every joint, also of the one that it does not name
    assert point.positions == pytest.approx([0.4, accepted.start.position[1]])
    rig.goes(boom=0.05)
    rig.stage.spin(
        lambda: rig.states and np.allclose(rig.states[-1].position, [0.4, 0.05], atol=1e-3)
    )
    last = rig.states[-1]
    assert list(last.name) == ["shoulder", "boom"]
    assert abs(last.effort[0]) <= 8.0 and math.isnan(last.effort[1])  # full effort: not told

    assert rig.change(Transition.TRANSITION_DEACTIVATE)
    assert rig.free()
    rig.send("asleep", shoulder=0.0)
    assert "not active" in rig.becomes("asleep", Motion.REFUSED).message
    assert "torque is off" in rig.is_in(DriverState.INACTIVE).message
    again = rig.stage.node.create_client(ChangeState, "servo_driver/change_state")
    for nothing_to_do in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CONFIGURE, 250):
        asked = ChangeState.Request(transition=Transition(id=nothing_to_do))
        assert not rig.stage.call(again, asked).success
    assert rig.joints()["shoulder"] == pytest.approx(0.4, abs=1e-3)
    assert rig.change(Transition.TRANSITION_ACTIVATE)
    assert rig.driving()
    assert rig.joints()["shoulder"] == pytest.approx(0.4, abs=1e-3)
    rig.is_idle()
    rig.goes(shoulder=0.1)
    assert rig.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert rig.free()
    rig.process.send_signal(signal.SIGINT)
    assert rig.process.wait(timeout=300) == 0
    rig.stage.spin(lambda: "ended" in rig.is_in(DriverState.UNCONFIGURED).message)


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
    with rig.emulator.motor(1) as motor:
        motor.blocked = True
    rig.send("blocked", shoulder=0.8, boom=0.05)
    rig.stage.spin(lambda: "shoulder" in rig.told(": arm"))
    assert "shoulder" in rig.becomes("blocked", Motion.ACCEPTED, Motion.BROKEN_OFF).message
    assert "shoulder" in rig.is_in(DriverState.FAULT).message
    with rig.emulator.motor(1) as motor:
        motor.blocked = False
    rig.dies()
    rig.start()  # it could not see that the servo had stalled
    assert "shoulder stalled" in rig.is_in(DriverState.FAULT).message
    rig.send("unasked", shoulder=0.8)
    assert "shoulder stalled" in rig.becomes("unasked", Motion.REFUSED).message
    assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_idle()
    rig.goes(shoulder=0.2)


def test_an_unplugged_cable_is_told_and_taken_up_again(rig: Rig) -> None:
    rig.emulator.unplug()
    rig.stage.spin(lambda: "unplugged" in rig.told("servo bus"))
    rig.emulator.start()
    rig.stage.spin(lambda: rig.told("servo bus") == "every servo answers")
    if "idle" not in rig.told(": arm"):
        assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_idle()
    rig.goes(boom=0.03)


def test_servos_that_come_after_the_driver_are_no_error(rig: Rig) -> None:
    process = rig.begins_without_servos(patience_s=60.0)
    rig.stage.spin(lambda: "not usable" in rig.told("servo bus"))
    rig.emulator.start()
    rig.is_idle()
    said = rig.stage.output(process)
    assert "ERROR" not in said
    assert "WARN" not in said
    assert "waiting for the servos" in said


def test_a_servo_that_means_another_position_is_not_driven(rig: Rig) -> None:
    """Somebody stored an offset; then the file says so too."""
    rig.ends()
    rig.emulator._devices[1].put(31, 2, 1 << 11 | 300)
    rig.start()
    rig.stage.spin(lambda: rig.said and "homing_offset" in rig.said[-1].message)
    said = rig.is_in(DriverState.UNCONFIGURED).message
    assert "servo 1 of shoulder: homing_offset = -300 (register 31); allowed: 0" in said
    rig.send("blind", shoulder=0.3)
    rig.becomes("blind", Motion.REFUSED)
    assert rig.free()
    rig.ends()
    text, there = rig.file.read_text(), "full_effort: 8.0"
    rig.file.write_text(text.replace(there, f"{there}, stored: {{homing_offset: -300}}"))
    rig.start()
    rig.is_idle()
    rig.ends()
    rig.file.write_text(text)
    rig.emulator._devices[1].put(31, 2, 0)


def test_servos_that_stay_away_are_an_error(rig: Rig) -> None:
    process = rig.begins_without_servos(patience_s=0.0)
    rig.stage.spin(lambda: "ERROR" in rig.stage.output(process))
    rig.emulator.start()
    rig.is_idle()


@pytest.mark.parametrize("signals", [[signal.SIGINT] * 2, [signal.SIGTERM]])
def test_a_signal_lets_the_servos_go(rig: Rig, signals: list[signal.Signals]) -> None:
    for number in signals:
        rig.process.send_signal(number)
    assert rig.process.wait(timeout=300) == 0
    assert rig.free()


def test_a_killed_driver_leaves_the_arm_standing_and_its_successor_needs_no_clock(rig: Rig) -> None:
    rig.goes(shoulder=0.3)
    rig.dies()
    assert rig.driving()  # the arm does not drop
    rig.start(use_sim_time=True)  # /clock is waited for, and never comes
    rig.is_idle()
    assert rig.joints()["shoulder"] == pytest.approx(0.3, abs=1e-3)
    rig.send("timeless", Time(nanosec=1), shoulder=0.1)
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
        rig.goes(rig.states[-1].header.stamp, shoulder=0.0 if second == 50 else 1e-4 * second)
    rig.process.send_signal(signal.SIGINT)
    assert rig.process.wait(timeout=300) == 0


def test_parameters_are_described_and_wrong_ones_refused(rig: Rig, tmp_path: Path) -> None:
    client = rig.stage.node.create_client(DescribeParameters, "servo_driver/describe_parameters")
    listing = rig.stage.node.create_client(ListParameters, "servo_driver/list_parameters")
    every = rig.stage.call(listing, ListParameters.Request()).result.names
    own = [name for name in every if name.split(".")[0] not in ROS_OWN]
    names = ["rate_hz", "follower.silence_s", *own]
    described = rig.stage.call(client, DescribeParameters.Request(names=names)).descriptors
    assert len(own) > 30 and all(d.description and d.read_only for d in described)
    assert "\n" not in "".join(d.description for d in described)  # its own, not a section's
    assert described[1].additional_constraints == "above 0 to 5"
    assert described[0].floating_point_range[0].to_value == 500.0
    told = {name: d.additional_constraints for name, d in zip(names, described, strict=True)}
    assert told["joints.boom.pinion_radius_m"] == "from 1e-06 to 1e+06"
    assert told["joints.boom.direction"] == "one of 1, -1"
    assert told["joints.shoulder.type"] == "one of revolute, prismatic"
    free = {"zero_ticks", "lower", "upper"}  # any number
    numbers = (ParameterType.PARAMETER_INTEGER, ParameterType.PARAMETER_DOUBLE)
    assert not [
        d.name for d in described
        if d.type in numbers and d.name.split(".")[-1] not in free
        and not (d.additional_constraints or d.floating_point_range or d.integer_range)
    ]  # fmt: skip
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(rig.file.read_text().replace("gear_ratio", "gear_ration"))
    said = refusal(rig, "--params-file", str(wrong))
    assert "gear_ration" in said and "allowed" in said
    said = refusal(rig, "--params-file", str(rig.file), "-p", "rate_hz:=5.0")
    assert "rate_hz: 5.0; allowed: at least 10" in said


@pytest.mark.parametrize(
    ("shoulder", "words"),
    [
        ({"limits_deg": [-29, 58], "step_deg": 0.36}, "whole multiples of the servo's tick"),
        ({"limits_deg": [-29, 57]}, "joints.shoulder.upper: 1.0; allowed: -0.506145 to 0.994838"),
        (
            {"type": "prismatic", "limits_m": [-1, 1]},
            "joints.shoulder.type: 'revolute'; allowed: prismatic",
        ),
        ({"name": "elbow", "limits_deg": [-29, 58]}, "allowed: elbow, boom"),
    ],
)
def test_servos_that_contradict_the_arm_are_refused(
    rig: Rig, tmp_path: Path, shoulder: dict[str, Any], words: str
) -> None:
    arm = tmp_path / "arm.yaml"
    joints = [
        {"id": 1, "name": "shoulder", "type": "revolute"} | shoulder,
        {"id": 2, "name": "boom", "type": "prismatic", "alpha_deg": 90, "limits_m": [0, 0.1]},
    ]
    text = {"name": "arm", "convention": "mdh_craig", "tip": {"frame": 2}, "joints": joints}
    arm.write_text(yaml.safe_dump(text))
    said = refusal(rig, "--params-file", str(rig.file), "-p", f"arm:={arm}")
    assert words in said and str(arm) in said


def test_shaped_moves_arrive_and_shaping_needs_an_arm(rig: Rig, tmp_path: Path) -> None:
    beam = {"name": "mast", "row": 2, "role": "d", "length_m": 0.9, "E_pa": 2e9, "poisson": 0.3,
            "section": {"type": "tube", "od_m": 0.02, "id_m": 0.016}, "mass_kg": 0.3,
            "mass": "uniform", "body_length_m": 0.9}  # fmt: skip
    joints = [
        {"id": 1, "name": "shoulder", "type": "revolute", "limits_deg": [-29, 58]},
        {"id": 2, "name": "boom", "type": "prismatic", "alpha_deg": 90, "d_m": 0.9,
         "limits_m": [0, 0.1]},
    ]  # fmt: skip
    arm = tmp_path / "arm.yaml"
    text = {"name": "a", "convention": "mdh_craig", "tip": {"frame": 2}, "joints": joints}
    arm.write_text(yaml.safe_dump(text | {"links": [beam]}))
    rig.ends()
    without = rig.start(shaping=True)
    assert without.wait(timeout=300) == 2
    assert "shaping: True; allowed: false, or arm" in rig.stage.output(without)
    rig.start(shaping=True, arm=arm)
    rig.is_idle()
    rig.goes(shoulder=0.3, boom=0.05)


def test_a_driver_that_says_ready_takes_a_trajectory_before_its_first_cycle(rig: Rig) -> None:
    """Nor later, when the last reading is older than is believed: the servos are read first."""
    rig.ends()
    slow = {"max_step_s": 1.0, "silence_s": 1.0, "stall_time_s": 1.0, "blend_s": 2.0}
    rig.start(rate_hz=1.0, **{f"follower.{name}": value for name, value in slow.items()})
    rig.is_in(DriverState.READY)
    rig.send("at once", shoulder=0.2)
    rig.stage.spin(lambda: rig.events("at once"))
    assert rig.events("at once") == [Motion.ACCEPTED]
    rig.ends()
    rig.start()


def test_an_exception_in_a_transition_is_told(rig: Rig) -> None:
    """rclpy drops it, so the driver would only say that it is not configured."""

    class Broken(LifecycleNode):
        fault = ""

        @reporting_faults
        def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
            raise ZeroDivisionError("by zero")

    node = Broken("broken", context=rig.stage.node.context)
    try:
        node.health = Health(node, 1.0)
        assert node.trigger_configure() != TransitionCallbackReturn.SUCCESS
        assert node.fault == "on_configure: ZeroDivisionError: by zero"
        assert node.health.faults == 1
    finally:
        node.destroy_node()
