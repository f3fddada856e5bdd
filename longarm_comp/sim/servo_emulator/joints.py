"""The joints of emulated servos: servo of each joint and travel per tick.

They are read from the driver's configuration file, but converted by separate code. An error in the
driver, such as a wrong sign, then moves the simulated arm the wrong way and is noticed.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.sim.servo_emulator.wires import wire_of

_STALL_NM = 2.94  # torque of an STS3215 at full effort (12 V)
DATA_SHEETS: Mapping[str, Mapping[str, float]] = {
    # running free 0.18 A of 2.7 A stalled (12 V); present load in 0.1 %
    "sts3215": {"model": 777, "hold_share": 0.18 / 2.7, "load_units": 1000.0},
    # torque over current: none is left at 0.13 A, of its limit of 3.21 A; current in 2.69 mA
    "xm430-w350": {"model": 1020, "hold_share": 0.13 / 3.21, "load_units": 1193.0},
}
"""By model of the servo: fields of `MotorSpec`, from the makers' data sheets."""


@dataclass(frozen=True)
class EmulatedJoint:
    """One joint: value (rad, m) = travel * (ticks - zero), ``travel`` signed, per tick.

    ``full_effort``: N m or N at the joint when its servo gives its full effort; ``told``: whether
    the file gives it.  ``sheet``: fields of `MotorSpec` that the servo's data sheet gives.
    """

    name: str
    servo_id: int
    zero_ticks: float
    travel: float
    lower: float
    upper: float
    full_effort: float
    told: bool = False
    sheet: Mapping[str, Any] = field(default_factory=dict)

    @property
    def home(self) -> float:
        """The value 0, or the limit nearest to it, rad or m."""
        return min(max(0.0, self.lower), self.upper)

    def value(self, ticks: float) -> float:
        """Return the joint value at encoder ticks, rad or m."""
        return self.travel * (ticks - self.zero_ticks)

    def ticks(self, value: float) -> float:
        """Return the encoder ticks at a joint value (rad or m), not rounded."""
        return self.zero_ticks + value / self.travel


@dataclass(frozen=True)
class EmulatedArm:
    """The part of the configuration that the emulator needs."""

    protocol: str
    joints: tuple[EmulatedJoint, ...]

    def start_ticks(self) -> dict[int, float]:
        """Return the ticks, by servo id, at which each joint is at 0 or the limit nearest to it."""
        return {j.servo_id: j.ticks(j.home) for j in self.joints}

    def values(self, ticks: Mapping[int, float]) -> dict[str, float]:
        """Return joint values (rad, m) by name, in the order of the file."""
        return {j.name: j.value(ticks[j.servo_id]) for j in self.joints}


def read_arm(path: str | Path) -> EmulatedArm:
    """Read a servo driver's YAML, plain or as ROS parameters.

    Raises InputError if an entry is missing or wrong.
    """
    data = read_yaml(path)
    if isinstance(data, dict) and len(data) == 1:
        (only,) = data.values()
        data = only.get("ros__parameters", data) if isinstance(only, dict) else data
    try:
        protocol = str(data["bus"]["protocol"])
        turn = wire_of(protocol, path).ticks_per_turn
        joints = tuple(_make_joint(name, fields, turn) for name, fields in data["joints"].items())
    except (KeyError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        allowed = "bus.protocol and joints.<name>.servo_id, type, zero_ticks, lower, upper"
        raise InputError(path, "servo configuration", repr(error), allowed) from error
    return EmulatedArm(protocol, joints)


def _make_joint(name: str, fields: Mapping[str, Any], ticks_per_turn: float) -> EmulatedJoint:
    turn = 2.0 * math.pi  # rad, or the radius' m
    if fields["type"] == "prismatic" and "screw_lead_m" in fields:
        turn = float(fields["screw_lead_m"])
    elif fields["type"] == "prismatic":
        turn *= float(fields["pinion_radius_m"])
    gearing = float(fields.get("gear_ratio", 1.0)) * ticks_per_turn
    stall = _STALL_NM * 2.0 * math.pi * gearing / (turn * ticks_per_turn)
    joint = EmulatedJoint(
        name=str(name),
        servo_id=int(fields["servo_id"]),
        zero_ticks=float(fields["zero_ticks"]),
        travel=int(fields.get("direction", 1)) * turn / gearing,
        lower=float(fields["lower"]),
        upper=float(fields["upper"]),
        full_effort=float(fields.get("full_effort", stall)),
        told="full_effort" in fields,
        sheet=DATA_SHEETS.get(str(fields.get("model")), {}),
    )
    if not fields.get("multi_turn"):
        return joint
    # It has no homing offset, and counts from its first turn
    turns = math.floor(round(joint.ticks(joint.home)) / ticks_per_turn)
    return replace(joint, zero_ticks=joint.zero_ticks - turns * ticks_per_turn)
