"""Which servo drives which joint, and how: declared in YAML, checked once at the door.

``bus``: the port; ``joints``: one entry a joint, in the order of the arm; ``follower``: limits of
the trajectory follower. Joint values are rad (revolute) or m (prismatic), all else as the key says.
A ROS parameter file with these keys under ``ros__parameters`` is read as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from longarm_comp.core.errors import InputError
from longarm_comp.devices.servo_bus import MODELS, PROTOCOLS, SerialServoBus, ServoModel, open_bus

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Declared(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class BusConfig(_Declared):
    """The serial line."""

    protocol: str
    port: str
    baudrate: int = Field(1_000_000, gt=0)
    reply_timeout_s: float = Field(0.02, gt=0.0, le=1.0)
    retries: int = Field(2, ge=0, le=10)

    @field_validator("protocol")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in PROTOCOLS:
            raise ValueError("one of " + ", ".join(PROTOCOLS))
        return value


class FollowerConfig(_Declared):
    """Limits that hold for every joint; ticks are the servo's own.

    Attributes:
        blend_s: a new trajectory takes over from a running one within this time.
        max_step_s: a longer pause between two steps does not make a longer set-point step.
        silence_s: no trusted read-back for so long is a fault.
        stall_error_ticks, stall_time_s: so far off with full load for so long is a stall.
        lost_error_ticks: so far off for ``stall_time_s`` whatever the load is a fault.
        jump_ticks: a read-back further than this from where the joint can be is not believed.
    """

    blend_s: Positive = 0.2
    max_step_s: Positive = 0.1
    silence_s: Positive = 0.25
    stall_error_ticks: Positive = 40.0
    stall_time_s: Positive = 0.5
    lost_error_ticks: Positive = 400.0
    jump_ticks: Positive = 200.0


class JointConfig(_Declared):
    """One joint and its servo; ``lower``, ``upper``, ``max_velocity`` in rad or m.

    Attributes:
        zero_ticks: encoder reading at joint value 0.
        gear_ratio: servo turns for one turn of the joint (or of the screw or pinion).
        screw_lead_m, pinion_radius_m: travel of a prismatic joint; one of the two.
        direction: +1 when ticks grow with the joint value.
        max_load: share of the servo's full effort that counts as stalled, 0 to 1.
    """

    servo_id: int = Field(ge=0, le=252)
    model: str
    type: Literal["revolute", "prismatic"]
    zero_ticks: Finite
    direction: Literal[1, -1] = 1
    gear_ratio: Positive = 1.0
    screw_lead_m: Positive | None = None
    pinion_radius_m: Positive | None = Field(None, validate_default=True)
    multi_turn: bool = False
    lower: Finite
    upper: Finite
    max_velocity: Positive
    max_temperature_c: float = Field(65.0, ge=30.0, le=100.0)
    max_load: float = Field(0.8, gt=0.0, le=1.0)

    @field_validator("model")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in MODELS:
            raise ValueError("one of " + ", ".join(MODELS))
        return value

    @field_validator("pinion_radius_m")
    @classmethod
    def _one_transmission(cls, value: float | None, info: ValidationInfo) -> float | None:
        given = (value is not None) + (info.data.get("screw_lead_m") is not None)
        needed = int(info.data.get("type") == "prismatic")
        if "type" in info.data and given != needed:
            raise ValueError(
                "exactly one of screw_lead_m and pinion_radius_m"
                if needed
                else "no screw_lead_m or pinion_radius_m at a revolute joint"
            )
        return value

    @field_validator("upper")
    @classmethod
    def _ordered(cls, value: float, info: ValidationInfo) -> float:
        if value <= info.data.get("lower", -math.inf):
            raise ValueError(f"above lower ({info.data['lower']})")
        return value

    @property
    def servo(self) -> ServoModel:
        """The kind of servo."""
        return MODELS[self.model]

    @property
    def unit(self) -> str:
        """Of the joint value."""
        return "m" if self.type == "prismatic" else "rad"

    @property
    def si_per_tick(self) -> float:
        """rad or m the joint moves for one encoder tick, without the sign."""
        per_turn = 2.0 * math.pi
        if self.screw_lead_m is not None:
            per_turn = self.screw_lead_m
        elif self.pinion_radius_m is not None:
            per_turn = 2.0 * math.pi * self.pinion_radius_m
        return per_turn / (self.gear_ratio * self.servo.ticks_per_turn)

    @property
    def goal_range(self) -> tuple[int, int]:
        """Goals the servo accepts, ticks."""
        return self.servo.multi_turn if self.multi_turn else self.servo.single_turn

    @cached_property
    def tick_limits(self) -> tuple[int, int]:
        """Lowest and highest goal, ticks, rounded inwards so that no limit is passed."""
        ends = sorted(self._exact_ticks(limit) for limit in (self.lower, self.upper))
        return math.ceil(ends[0] - 1e-9), math.floor(ends[1] + 1e-9)

    def to_ticks(self, value: float) -> int:
        """The goal nearest to a joint value, rad or m.

        Raises:
            InputError: not finite, or outside the limits by more than half a tick.
        """
        slack = 0.5 * self.si_per_tick
        if not self.lower - slack <= value <= self.upper + slack:
            allowed = f"{self.lower:g} to {self.upper:g} {self.unit}"
            raise InputError(f"servo {self.servo_id}", "position", value, allowed)
        low, high = self.tick_limits
        return min(max(round(self._exact_ticks(value)), low), high)

    def to_si(self, ticks: float) -> float:
        """Joint value (rad or m) of an encoder reading."""
        return self.direction * (ticks - self.zero_ticks) * self.si_per_tick

    def speed_to_si(self, ticks_s: float) -> float:
        """Joint velocity (rad/s or m/s) of an encoder speed."""
        return self.direction * ticks_s * self.si_per_tick

    @property
    def max_speed_ticks_s(self) -> float:
        """``max_velocity`` at the servo."""
        return self.max_velocity / self.si_per_tick

    def _exact_ticks(self, value: float) -> float:
        return self.zero_ticks + self.direction * value / self.si_per_tick


class ServoConfig(_Declared):
    """The whole servo side of an arm; ``joints`` keeps the order of the file."""

    bus: BusConfig
    joints: dict[str, JointConfig] = Field(min_length=1)
    follower: FollowerConfig = FollowerConfig()

    @model_validator(mode="after")
    def _consistent(self) -> ServoConfig:
        owner: dict[int, str] = {}
        for name, joint in self.joints.items():
            where = f"joints.{name}"
            other = owner.setdefault(joint.servo_id, name)
            if other != name:
                _refuse(f"{where}.servo_id", joint.servo_id, f"an id that {other} does not use")
            if joint.servo.protocol != self.bus.protocol:
                known = [m.name for m in MODELS.values() if m.protocol == self.bus.protocol]
                _refuse(f"{where}.model", joint.model, "one of " + ", ".join(known))
            low, high = joint.goal_range
            for field, limit in (("lower", joint.lower), ("upper", joint.upper)):
                ticks = joint.zero_ticks + joint.direction * limit / joint.si_per_tick
                if not low - 0.5 <= ticks <= high + 0.5:
                    ends = sorted((joint.to_si(low), joint.to_si(high)))
                    hint = "" if joint.multi_turn else "; multi_turn: true gives more turns"
                    allowed = f"{ends[0]:.6g} to {ends[1]:.6g} {joint.unit} in its turns{hint}"
                    _refuse(f"{where}.{field}", limit, allowed)
            if joint.tick_limits[0] > joint.tick_limits[1]:
                _refuse(f"{where}.upper", joint.upper, "at least one encoder tick above lower")
        return self

    @property
    def models(self) -> dict[int, ServoModel]:
        """The kind of each servo, by id."""
        return {joint.servo_id: joint.servo for joint in self.joints.values()}

    @property
    def ids(self) -> dict[str, int]:
        """Servo id of each joint, in order."""
        return {name: joint.servo_id for name, joint in self.joints.items()}

    def open_bus(self) -> SerialServoBus:
        """Open the port. Raises BusUnplugged."""
        bus = self.bus
        return open_bus(
            bus.protocol, bus.port, bus.baudrate, self.models, bus.reply_timeout_s, bus.retries
        )

    @classmethod
    def load(cls, path: str | Path) -> ServoConfig:
        """Read a YAML file, plain or as ROS parameters. Raises InputError naming the field."""
        try:
            data = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(path, "file", type(error).__name__, "a readable file") from error
        except yaml.YAMLError as error:
            raise InputError(path, "YAML", error, "valid YAML") from error
        return cls.parse(_without_ros(data), str(path))

    @classmethod
    def parse(cls, data: Any, where: str) -> ServoConfig:
        """From nested mappings; ``where`` names the source. Raises InputError naming the field."""
        if not isinstance(data, Mapping):
            raise InputError(where, "document", type(data).__name__, "a mapping of keys")
        try:
            return cls.model_validate(dict(data))
        except InputError as error:
            raise InputError(where, error.field, error.value, error.allowed) from error
        except ValidationError as error:
            fault = error.errors(include_url=False)[0]
            field = ".".join(str(part) for part in fault["loc"])
            allowed = fault["msg"].removeprefix("Value error, ")
            if fault["type"] == "extra_forbidden":
                allowed = "known keys: " + ", ".join(_known_keys(fault["loc"]))
            value = "missing" if fault["type"] == "missing" else fault["input"]
            raise InputError(where, field, value, allowed) from error


def _refuse(field: str, value: object, allowed: str) -> None:
    raise InputError("servo configuration", field, value, allowed)


def _known_keys(loc: tuple[int | str, ...]) -> list[str]:
    """Keys allowed where an unknown one was found."""
    sections: dict[object, type[BaseModel]] = {
        "bus": BusConfig,
        "joints": JointConfig,
        "follower": FollowerConfig,
    }
    owner = ServoConfig if len(loc) == 1 else sections[loc[0]]
    return list(owner.model_fields)


def _without_ros(data: Any) -> Any:
    """The parameters inside a ROS parameter file; keys of other readers are left to them."""
    if isinstance(data, Mapping) and len(data) == 1:
        (node,) = data.values()
        if isinstance(node, Mapping) and "ros__parameters" in node:
            params = node["ros__parameters"] or {}
            return {key: params[key] for key in ServoConfig.model_fields if key in params}
    return data
