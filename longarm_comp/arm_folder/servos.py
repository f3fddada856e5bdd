"""Finds servo settings that fit an arm: gearing by the joints' ranges and steps, and limits."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from longarm_comp.arm_folder.parameter_file import edit_text, own_parameters
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.joint import Joint
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import parse_yaml
from longarm_comp.devices.servo_bus.registry import models
from longarm_comp.devices.servo_bus.state import ServoModel
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_joint import JointConfig

SERVOS = "servo_driver.yaml"
KEYS = ("servo_id", "model", "direction", "zero_ticks", "stored")
"""Keys of each joint that a servo setup finds."""


def with_joints(
    text: str, bus: Mapping[str, Any], joints: Mapping[str, JointConfig], where: object
) -> str:
    """Return the text of a servo file with new values of the bus and of each joint's `KEYS`."""
    old = ServoConfig.parse(parse_yaml(text, str(where)), str(where))
    values: dict[tuple[str, ...], Any] = {
        ("bus", key): v for key, v in bus.items() if v != getattr(old.bus, key)
    }
    for name, joint in joints.items():
        for key in KEYS:
            if getattr(joint, key) != getattr(old.joints[name], key):
                values["joints", name, key] = getattr(joint, key)
    made = edit_text(text, values, where)
    ServoConfig.parse(parse_yaml(made, str(where)), str(where))  # refuses what does not fit a turn
    return made


ROUNDING_TICKS = 1.5
"""Limits that differ by no more than this many ticks count as equal, because of rounding."""


def find_contradictions(
    servos: ServoConfig, arm: Arm, where: str, file: str
) -> Iterator[InputError]:
    """Yield an error for each contradiction between the servos and an arm's joints.

    The servos must be the arm's, of the type of their joints, within the joints' limits, and
    able to stand at the declared steps.

    Args:
        where: name of the servos' file, for messages.
        file: name of the arm's file.
    """
    if sorted(servos.joints) != sorted(arm.joint_names):
        theirs = f"{', '.join(arm.joint_names)}, as in {file}"
        yield InputError(where, "joints", ", ".join(servos.joints), theirs)
        return
    rows = [arm.joints[number - 1] for number in arm.commanded]
    for name, declared, low, high in zip(arm.joint_names, rows, *arm.bounds, strict=True):
        joint, field = servos.joints[name], f"joints.{name}"
        if joint.type != declared.type:
            allowed = f"{declared.type}, as in {file}"
            yield InputError(where, f"{field}.type", joint.type, allowed)
            continue
        slack = ROUNDING_TICKS * joint.si_per_tick
        for end, limit in (("lower", joint.lower), ("upper", joint.upper)):
            if not low - slack <= limit <= high + slack:
                allowed = f"{low:.6g} to {high:.6g} {joint.unit}, as in {file}"
                yield InputError(where, f"{field}.{end}", limit, allowed)
        if declared.step > 0 and not joint.stands_at(declared.step):
            tick = joint.si_per_tick
            allowed = f"whole multiples of the servo's tick, {tick:.9g} {joint.unit}"
            if joint.zero_ticks != round(joint.zero_ticks):
                allowed += f", and a whole number of zero_ticks, not {joint.zero_ticks:g}"
            yield InputError(file, f"step of {name}", declared.step, allowed)


DEFAULT_MODEL = "sts3215"
_SHARE, _SMALL_TICKS_S = 0.85, 3000.0
"""Highest velocity of a joint as a share of its servo's no-load speed; and the highest no-load
speed that is assumed, ticks/s."""


def servo_section(
    arm: Arm,
    model: str = DEFAULT_MODEL,
    direct: bool = False,
    fastest: Mapping[int, float] | None = None,
) -> dict[str, Any]:
    """Return the section ``joints`` of a servo driver's file, in the order of the arm.

    The gearing is assumed. If arm.yaml declares a step of the joint, one tick of the servo is that
    step. Otherwise it is the demonstration's (10:1, a pinion of 8 mm), changed as far as needed so
    that the joint's range fits into the turns of the servo.

    Args:
        direct: the horns of the servos turn the revolute joints, as in printed arms. These then
            have no gearing and one turn, whatever their step, and none of them alone moves the tip
            faster than 0.25 m/s.
        fastest: highest velocities of joints, rad/s or m/s, by row; the servos limit all others.

    Raises:
        InputError: the servo model is not known, a step is too small for its turns, or the servo
            configuration is not valid.
    """
    if model not in models():
        raise InputError("init", "--servos", model, ", ".join(models()))
    horn_m = reach(arm) if direct else 0.0
    made = {
        name: _fit_servo(
            number, arm.joints[row - 1], models()[model], horn_m, (fastest or {}).get(row, math.inf)
        )
        for number, (name, row) in enumerate(zip(arm.joint_names, arm.commanded, strict=True), 1)
    }
    protocol = models()[model].protocol
    ServoConfig.parse({"bus": {"protocol": protocol, "port": "-"}, "joints": made}, "servos")
    return made


def _fit_servo(
    number: int, joint: Joint, model: ServoModel, reach_m: float, fastest: float
) -> dict[str, Any]:
    """Return the entry of a joint in the servo file.

    `reach_m` is the arm's if the servos' horns turn the joints, and 0 for geared servos. `fastest`
    is the highest velocity of the joint, rad/s or m/s.
    """
    horn = reach_m > 0.0 and joint.type == "revolute"
    low, high = model.multi_turn
    middle = model.ticks_per_turn / 2  # of the first turn: stands there until the zero is measured
    # Share of the servo's turns that a joint's range may take
    room = 0.98 * min(high - middle, middle - low)
    farthest = max(map(abs, joint.limits))
    if joint.step and farthest / joint.step > room:
        allowed = f"at least {farthest / room:.3g} with {model.name}, or a servo with more turns"
        raise InputError("servos", f"step of {joint.name or joint.id}", joint.step, allowed)
    transmission, tick = _fit_gearing(joint, farthest / room, model.ticks_per_turn)
    if horn:
        transmission, tick = {"gear_ratio": 1.0}, 2 * math.pi / model.ticks_per_turn
    # Whole turns lower, so that the servo stands in its first turn with the joint nearest to 0
    home = min(max(0.0, joint.limits[0]), joint.limits[1])
    turns = 0 if horn else math.floor((middle + round(home / tick)) / model.ticks_per_turn)
    speed = _SHARE * min(_SMALL_TICKS_S, model.top_speed_ticks_s or math.inf) * tick
    # Speed of the tip at which people may stand beside an arm (ISO 10218-1, reduced speed)
    speed = min(speed, 0.25 / reach_m) if horn else speed
    return {
        "servo_id": number,
        "model": model.name,
        "type": joint.type,
        "zero_ticks": middle - turns * model.ticks_per_turn,
        **transmission,
        "multi_turn": not horn,
        "lower": round(joint.limits[0], 7),
        "upper": round(joint.limits[1], 7),
        "max_velocity": min(float(f"{speed:.2g}"), fastest),
    }


def _fit_gearing(joint: Joint, least: float, turn: int) -> tuple[dict[str, Any], float]:
    """Return the keys of the gearing, and the joint's motion for one tick (rad or m).

    With less than `least` for one tick the joint's range does not fit. `turn` is one of the servo.
    """
    own = own_parameters("servo_driver")  # the demonstration's gearing, assumed until it is told
    if joint.type == "prismatic":
        if joint.step:
            return {"screw_lead_m": joint.step * turn}, joint.step
        smallest = math.ceil(1e3 * least * turn / (2 * math.pi)) / 1e3
        radius = max(own["joints.joint3.pinion_radius_m"], smallest)
        return {"pinion_radius_m": radius}, 2 * math.pi * radius / turn
    largest = 2 * math.pi / (turn * least)
    gear = min(own["joints.joint1.gear_ratio"], math.floor(10 * largest) / 10 or largest)
    if joint.step:
        gear = 2 * math.pi / (turn * joint.step)
    return {"gear_ratio": gear}, 2 * math.pi / (turn * gear)
