"""The servo configuration: conversions, and errors that name the field."""

import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from longarm_comp.arm_folder.servos import find_contradictions
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.devices.servo_bus.registry import models
from longarm_comp.devices.servo_config import JointConfig, ServoConfig

REVOLUTE: dict[str, Any] = {
    "servo_id": 1,
    "model": "sts3215",
    "type": "revolute",
    "zero_ticks": 2048,
    "lower": -1.0,
    "upper": 1.2,
    "max_velocity": 1.0,
}
SCREW = REVOLUTE | {
    "servo_id": 2,
    "type": "prismatic",
    "screw_lead_m": 0.008,
    "multi_turn": True,
    "lower": 0.0,
    "upper": 0.05,
    "max_velocity": 0.005,
}
GEARED = REVOLUTE | {"gear_ratio": 10.0, "multi_turn": True, "max_velocity": 0.5}
RACK = REVOLUTE | {
    "servo_id": 3,
    "type": "prismatic",
    "pinion_radius_m": 0.018,
    "zero_ticks": 4000,
    "direction": -1,
    "lower": 0.0,
    "upper": 0.1,
    "max_velocity": 0.05,
}


def _document(**joints: dict[str, Any]) -> dict[str, Any]:
    return {"bus": {"protocol": "feetech", "port": "/dev/null"}, "joints": joints}


def _refused(data: Any) -> str:
    with pytest.raises(InputError) as caught:
        ServoConfig.parse(data, "servo.yaml")
    assert caught.value.where == "servo.yaml"
    return f"{caught.value.field} | {caught.value}"


def test_a_tick_is_what_the_gearing_makes_of_it() -> None:
    assert JointConfig(**REVOLUTE).si_per_tick == pytest.approx(2 * math.pi / 4096)
    geared = JointConfig(**REVOLUTE | {"gear_ratio": 5.0})
    assert geared.si_per_tick == pytest.approx(2 * math.pi / 4096 / 5)
    assert JointConfig(**SCREW).si_per_tick == pytest.approx(0.008 / 4096)
    assert JointConfig(**RACK).si_per_tick == pytest.approx(2 * math.pi * 0.018 / 4096)


@pytest.mark.parametrize("fields", [REVOLUTE, SCREW, RACK])
def test_every_tick_within_the_limits_comes_back_unchanged(fields: dict[str, Any]) -> None:
    joint = JointConfig(**fields)
    low, high = joint.tick_limits
    assert all(joint.to_ticks(joint.to_si(t)) == t for t in range(low, high + 1))
    assert joint.to_si(joint.zero_ticks) == 0.0


@pytest.mark.parametrize("fields", [REVOLUTE, SCREW, RACK])
def test_a_goal_at_a_limit_is_not_rounded_past_it(fields: dict[str, Any]) -> None:
    joint = JointConfig(**fields)
    for limit in (joint.lower, joint.upper):
        reached = joint.to_si(joint.to_ticks(limit))
        assert joint.lower - 1e-12 <= reached <= joint.upper + 1e-12
        assert abs(reached - limit) < joint.si_per_tick


def test_direction_turns_position_and_speed_around() -> None:
    joint = JointConfig(**RACK)
    assert joint.to_ticks(0.05) < joint.to_ticks(0.01)
    assert joint.speed_to_si(100.0) == pytest.approx(-100 * joint.si_per_tick)


@pytest.mark.parametrize("value", [1.3, -1.1, math.nan, math.inf])
def test_values_outside_the_limits_are_refused(value: float) -> None:
    with pytest.raises(InputError, match=r"-1 to 1\.2 rad"):
        JointConfig(**REVOLUTE).to_ticks(value)


@pytest.mark.parametrize(
    ("change", "field", "said"),
    [
        ({"servo_id": 999}, "joints.a.servo_id", "252"),
        ({"model": "mg996r"}, "joints.a.model", "sts3215"),
        ({"model": "xl430-w250"}, "joints.a.model", "sts3215"),
        ({"type": "ball"}, "joints.a.type", "revolute"),
        ({"direction": 0}, "joints.a.direction", "1 or -1"),
        ({"gear_ratio": 0.0}, "joints.a.gear_ratio", "greater than or equal to 0.000001"),
        ({"zero_ticks": math.nan}, "joints.a.zero_ticks", "finite"),
        ({"upper": -2.0}, "joints.a.upper", "above lower"),
        ({"lower": -4.0}, "joints.a.lower", "multi_turn"),
        ({"zero_ticks": 4000}, "joints.a.upper", "multi_turn"),
        ({"max_velocity": -1}, "joints.a.max_velocity", "greater than 0"),
        ({"max_velocity": 45.0}, "joints.a.max_velocity", "at most 5.236 rad/s"),
        ({"top_speed_ticks_s": 100.0}, "joints.a.max_velocity", "at most 0.1534 rad/s"),
        ({"screw_lead_m": 0.008}, "joints.a.pinion_radius_m", "revolute"),
        ({"type": "prismatic"}, "joints.a.pinion_radius_m", "exactly one of"),
        ({"max_tempreature_c": 60}, "joints.a.max_tempreature_c", "max_temperature_c"),
    ],
)
def test_a_wrong_field_is_named_with_what_is_allowed(
    change: dict[str, Any], field: str, said: str
) -> None:
    message = _refused(_document(a=REVOLUTE | change))
    assert message.startswith(field + " |")
    assert said in message


@pytest.mark.parametrize(("field", "zero", "beyond"), [("lower", 40, -1), ("upper", 4055, 1)])
def test_limits_within_one_turn_keep_away_from_where_the_encoder_jumps(
    field: str, zero: int, beyond: int
) -> None:
    """There a servo that rests beside its goal would turn to it the other way round."""
    own = REVOLUTE | {field: 0.0, "zero_ticks": zero}
    past = own | {"zero_ticks": zero + beyond}
    ServoConfig.parse(_document(a=own), "servo.yaml")
    last = models()["sts3215"].multi_turn[field == "upper"]
    many = REVOLUTE | {field: (last - 2048) * 2 * math.pi / 4096, "multi_turn": True}
    ServoConfig.parse(_document(a=many), "servo.yaml")
    for told in (_document(a=past), _document(a=own) | {"follower": {"stall_error_ticks": 41.0}}):
        said = _refused(told)
        assert said.startswith(f"joints.a.{field} |") and "stall_error_ticks" in said
        assert "the middle of the range reads 2048, not" in said
    wide = REVOLUTE | {"lower": -3.1, "upper": 3.0}
    assert "mount" not in _refused(_document(a=wide | {"upper": 3.1}))
    assert "not 2015" in _refused(_document(a=wide))


HALF = math.pi / 10  # of a turn of the servo, at the joint, rad
DXL = {"model": "xl430-w250"}


@pytest.mark.parametrize(
    ("change", "low", "high"),
    [
        ({}, 0, 4095),
        # Below 0 alone: at its upper limit, half a turn of the servo off, it stands in that turn
        ({"lower": -1.0, "upper": -HALF}, 2048, 6143),
        ({"lower": -1.0, "upper": -HALF, "direction": -1}, -2048, 2047),
        ({"lower": HALF}, -2048, 2047),
        (DXL, 0, 4095),
        (DXL | {"stored": {"homing_offset": 300}}, 300, 4395),
        (DXL | {"stored": {"homing_offset": -5000}}, -5000, -905),
        # A reversed servo may count up or down from 0; only there it reads the same
        (DXL | {"stored": {"drive_mode_reverse": 1}}, 0, 0),
        (DXL | {"stored": {"drive_mode_reverse": 1, "homing_offset": 300}}, 300, 300),
        # A Feetech servo may or may not shift that turn: what both turns have
        ({"stored": {"homing_offset": 300}}, 0, 3795),
        ({"stored": {"homing_offset": -300}}, 300, 4095),
        ({"stored": {"phase_position_reversed": 1}}, 0, 0),
        ({"stored": {"phase_position_reversed": 1, "homing_offset": 300}}, 0, 0),
    ],
)
def test_a_zero_of_many_turns_is_in_the_turn_that_is_read_after_power_on(
    change: dict[str, Any], low: int, high: int
) -> None:
    document = _document(a=GEARED | change)
    if "model" in change:
        document["bus"]["protocol"] = "dynamixel"

    def at(zero: float) -> dict[str, Any]:
        return document | {"joints": {"a": document["joints"]["a"] | {"zero_ticks": zero}}}

    for zero in (low, high):
        ServoConfig.parse(at(zero), "servo.yaml")
    for zero in (low - 1, high + 1):
        said = _refused(at(zero))
        assert said.startswith("joints.a.zero_ticks |") and f"allowed: {low} to {high}, " in said
        if high - low < 4095:
            assert "set its homing_offset and reversal to 0 with the maker's tool" in said
            continue
        same = float(said.split("for instance ")[1].split(",")[0])
        assert (same - zero) % 4096 == 0
        ServoConfig.parse(at(same), "servo.yaml")
    if "stored" in change:  # with one turn, only the limits decide
        one = {"multi_turn": False, "gear_ratio": 1.0, "lower": 0.0, "upper": 0.1}
        for zero in (60, 3900):
            shifted = document["joints"]["a"] | one | {"zero_ticks": zero}
            ServoConfig.parse(document | {"joints": {"a": shifted}}, "servo.yaml")


@pytest.mark.parametrize("geared", [{}, {"gear_ratio": 2.0}])
def test_an_error_of_half_a_turn_of_the_servo_guards_against_nothing(
    geared: dict[str, Any],
) -> None:
    half = ServoConfig.parse(_document(a=REVOLUTE | geared), "servo.yaml").joints["a"]
    most = 2048 * half.si_per_tick
    ServoConfig.parse(_document(a=REVOLUTE | geared | {"max_error": most}), "servo.yaml")
    said = _refused(_document(a=REVOLUTE | geared | {"max_error": 1.001 * most}))
    assert (
        said.startswith("joints.a.max_error |") and f"at most {most:.4g} rad, half a turn" in said
    )


def test_wrong_documents_are_named() -> None:
    assert "missing" in _refused({"joints": {"a": REVOLUTE}})
    assert "servo_id" in _refused(_document(a=REVOLUTE, b=SCREW | {"servo_id": 1}))
    assert "feetech, dynamixel" in _refused(
        _document(a=REVOLUTE) | {"bus": {"protocol": "canopen", "port": "x"}}
    )
    assert "follower" in _refused(_document(a=REVOLUTE) | {"limits": {}})
    assert _refused([1]).startswith("document")
    assert _refused(_document()).startswith("joints")


def test_a_faster_servo_of_a_model_may_be_declared() -> None:
    fast = REVOLUTE | {"max_velocity": 9.0, "top_speed_ticks_s": 6000.0}
    assert ServoConfig.parse(_document(a=fast), "servo.yaml").joints["a"].max_velocity == 9.0


@pytest.mark.parametrize(
    ("limit", "most", "allowed"),
    [
        ("silence_s", 5.0, "5"),
        ("stall_time_s", 5.0, "5"),
        ("blend_s", 2.0, "2"),
        ("max_step_s", 1.0, "1"),
        ("trim_pause_s", 60.0, "60"),
        ("lost_error_ticks", 2048.0, "at most 2048, half a turn"),
        ("stall_error_ticks", 2048.0, "at most 2048, half a turn"),
        ("jump_ticks", 2048.0, "at most 2048, half a turn"),
        ("trim_ticks", 2048.0, "at most 2048, half a turn"),
    ],
)
def test_a_limit_that_guards_against_nothing_is_refused(
    limit: str, most: float, allowed: str
) -> None:
    data = _document(a=REVOLUTE | {"multi_turn": True})
    long = {"silence_s": 5.0, "stall_time_s": 5.0}
    ServoConfig.parse(data | {"follower": long | {limit: most}}, "servo.yaml")
    said = _refused(data | {"follower": long | {limit: 1.001 * most}})
    assert said.startswith(f"follower.{limit} |") and allowed in said


@pytest.mark.parametrize(
    ("bus", "follower", "wrong"),
    [
        ({"reply_timeout_s": 0.1, "retries": 2}, {"silence_s": 0.3}, ""),
        ({"reply_timeout_s": 0.1, "retries": 2}, {"silence_s": 0.29}, "bus.reply_timeout_s"),
        ({"reply_timeout_s": 0.1, "retries": 3}, {"silence_s": 0.3}, "bus.reply_timeout_s"),
        ({"reply_timeout_s": 1.0, "retries": 10}, {}, "bus.reply_timeout_s"),
        ({}, {"max_step_s": 0.25}, ""),
        ({}, {"max_step_s": 0.26}, "follower.max_step_s"),
        ({}, {"stall_time_s": 0.1}, ""),
        ({}, {"stall_time_s": 0.09}, "follower.max_step_s"),
    ],
)
def test_durations_that_contradict_each_other_are_refused(
    bus: dict[str, Any], follower: dict[str, Any], wrong: str
) -> None:
    document = _document(a=REVOLUTE)
    document["bus"] |= bus
    document["follower"] = follower
    if wrong:
        assert _refused(document).startswith(f"{wrong} |")
    else:
        ServoConfig.parse(document, "servo.yaml")


@pytest.mark.parametrize(
    ("rate_hz", "follower", "wrong"),
    [
        (10.0, {}, ""),
        (9.9, {}, "follower.max_step_s"),
        (20.0, {"max_step_s": 0.05}, ""),
        (19.9, {"max_step_s": 0.05}, "follower.max_step_s"),
        (50.0, {"blend_s": 0.04}, ""),
        (50.0, {"blend_s": 0.039}, "follower.blend_s"),
    ],
)
def test_a_rate_must_be_high_enough_for_the_follower(
    rate_hz: float, follower: dict[str, Any], wrong: str
) -> None:
    config = ServoConfig.parse(_document(a=REVOLUTE) | {"follower": follower}, "servo.yaml")
    if not wrong:
        config.check_rate(rate_hz, "here")
        return
    with pytest.raises(InputError) as caught:
        config.check_rate(rate_hz, "here")
    assert (caught.value.where, caught.value.field) == ("here", "rate_hz")
    assert wrong in str(caught.value)


def test_plain_and_ros_parameter_files_are_read(tmp_path: Path) -> None:
    data = _document(b=SCREW, a=REVOLUTE)
    plain, ros = tmp_path / "plain.yaml", tmp_path / "ros.yaml"
    plain.write_text(yaml.safe_dump(data, sort_keys=False))
    params = data | {"rate_hz": 50.0}
    ros.write_text(yaml.safe_dump({"/**": {"ros__parameters": params}}, sort_keys=False))
    config = ServoConfig.load(plain)
    assert config == ServoConfig.load(ros)
    assert list(config.ids.items()) == [("b", 2), ("a", 1)]
    with pytest.raises(InputError, match="a readable file"):
        ServoConfig.load(tmp_path / "none.yaml")
    plain.write_text("bus: [")
    with pytest.raises(InputError, match="valid YAML"):
        ServoConfig.load(plain)


TICK = 2 * math.pi / 4096


@pytest.mark.parametrize(
    ("fields", "step", "stands"),
    [
        (REVOLUTE, TICK, True),
        (REVOLUTE, 4 * TICK, True),
        (REVOLUTE, 4 * TICK * (1 + 1e-9), True),
        (REVOLUTE, 4.1 * TICK, False),
        (REVOLUTE, 2 * math.pi / 1000, False),  # 4.096 ticks: off by half a step after five
        (REVOLUTE, 0.4 * TICK, False),
        (GEARED, 5 * TICK / 10, True),
        (GEARED, 2 * math.pi / 1000, False),
        (REVOLUTE | {"zero_ticks": 2048.5}, TICK, False),
        (REVOLUTE | {"zero_ticks": 2048.5}, 4 * TICK, True),  # known to an eighth
        (SCREW, 0.008 / 4096, True),
        (SCREW, 1e-4, False),  # 51.2 ticks
        (SCREW, 0.008 / 64, True),
        (RACK, 7 * 2 * math.pi * 0.018 / 4096, True),
    ],
)
def test_a_declared_step_must_be_one_that_the_servo_has(
    fields: dict[str, Any], step: float, stands: bool
) -> None:
    joint = JointConfig(**fields)
    assert joint.stands_at(step) is stands
    for k in (-3, 1, 7) if stands else ():  # by the goals that are really sent
        at = k * step
        if joint.lower < at < joint.upper:
            assert abs(joint.to_si(joint.to_ticks(at)) - at) <= 0.15 * step
    turns = fields["type"] == "revolute"
    row = {"step_deg": math.degrees(step)} if turns else {"step_m": step}
    assert _said(fields, {}) == ""
    said = _said(fields, row)
    assert bool(said) is not stands
    assert stands or (said.startswith("arm.yaml: step of arm: ") and "whole multiples" in said)


def _said(fields: dict[str, Any], row: dict[str, Any]) -> str:
    """What servos of one joint say of an arm whose joint is theirs, with other keys."""
    turns = fields["type"] == "revolute"
    ends = [fields["lower"], fields["upper"]]
    limits = {"limits_deg": [math.degrees(v) for v in ends]} if turns else {"limits_m": ends}
    joint = {"id": 1, "name": "arm", "type": fields["type"]} | limits | row
    joint = {key: value for key, value in joint.items() if value is not None}
    whole = {"name": "a", "convention": "mdh_craig", "tip": {"frame": 1}, "joints": [joint]}
    config = ServoConfig.parse(_document(arm=fields), "servo.yaml")
    arm = Arm.parse(whole, "arm.yaml")
    return "; ".join(map(str, find_contradictions(config, arm, "servo.yaml", "arm.yaml")))


def test_servos_that_contradict_the_arm_are_named() -> None:
    slack = 1.4 * TICK
    assert (
        _said(REVOLUTE, {"limits_deg": [math.degrees(-1 + slack), math.degrees(1.2 - slack)]}) == ""
    )
    assert _said(REVOLUTE, {"limits_deg": [-180, 180]}) == ""  # the servo keeps the narrower ones
    said = _said(REVOLUTE, {"limits_deg": [-57, 68]})
    assert said.startswith("servo.yaml: joints.arm.lower: -1.0; allowed: -0.994838 to 1.18682 rad")
    assert "joints.arm.upper: 1.2; " in said
    said = _said(REVOLUTE, {"type": "prismatic", "limits_deg": None, "limits_m": [-1.0, 1.2]})
    assert said == "servo.yaml: joints.arm.type: 'revolute'; allowed: prismatic, as in arm.yaml"
    said = _said(REVOLUTE, {"name": "boom"})
    assert said == "servo.yaml: joints: 'arm'; allowed: boom, as in arm.yaml"
    endless = {"endless": True, "limits_deg": [-20, 20]}
    assert _said(REVOLUTE, endless) == ""
