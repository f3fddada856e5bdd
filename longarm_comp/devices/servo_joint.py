"""One joint and its servo: configuration, and conversions between joint value and ticks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, ValidationInfo, field_validator, model_validator

from longarm_comp.core.errors import InputError
from longarm_comp.core.yaml_file import Declared, Misdeclared
from longarm_comp.devices.servo_bus.registry import models, protocols
from longarm_comp.devices.servo_bus.state import ServoModel

Positive = Annotated[float, Field(gt=0.0)]
_Transmission = Annotated[float, Field(ge=1e-6, le=1e6)]
"""A gear ratio, or a length in m of a screw or pinion; a value out of range has a wrong unit."""


class ServoSettings(Declared):
    """Base of the configuration records. Types are strict: a number in quotes is an error."""

    model_config = ConfigDict(strict=True)


class JointConfig(ServoSettings):
    """One joint and its servo; ``lower``, ``upper``, ``max_velocity`` in rad or m."""

    servo_id: int = Field(ge=0, le=252, description="on the bus")
    model: str = Field(description="of the servo")
    type: Literal["revolute", "prismatic"] = Field(description="revolute or prismatic")
    zero_ticks: float = Field(description="encoder reading at joint value 0")
    direction: Literal[1, -1] = Field(1, description="+1 when ticks grow with the joint value")
    gear_ratio: _Transmission = Field(
        1.0, description="servo turns for one turn of the joint, of the screw or of the pinion"
    )
    screw_lead_m: _Transmission | None = Field(
        None, description="travel of a prismatic joint by a turn of its screw, m"
    )
    pinion_radius_m: _Transmission | None = Field(
        None, description="of a prismatic joint's pinion instead, m"
    )
    multi_turn: bool = Field(
        False,
        description="the servo turns more than once over the range. It loses its turn count "
        "without power, so the joint must be within the turn of its zero at power-on (where 0 is "
        "out of its limits: of the limit nearest to 0)",
    )
    lower: float = Field(description="limit, rad or m")
    upper: float = Field(description="limit, rad or m")
    max_velocity: Positive = Field(
        description="rad/s or m/s, at most what the servo does through its gearing"
    )
    top_speed_ticks_s: Positive | None = Field(
        None,
        description="highest speed of the servo without load, ticks/s; absent: by the data sheet "
        "of its model, which other gearings of the same model exceed",
    )
    max_temperature_c: float = Field(
        65.0,
        ge=30.0,
        le=100.0,
        description="highest temperature of the servo; a hotter one is a fault, degC",
    )
    max_load: float = Field(
        0.8, gt=0.0, le=1.0, description="share of full effort that counts as stalled"
    )
    max_error: Positive | None = Field(
        None,
        description="rad or m off its goal that is a fault at any load; absent: the follower's "
        "lost_error_ticks",
    )
    full_effort: Positive | None = Field(
        None,
        description="N m or N at the joint at the servo's full effort, for joint_states; absent: "
        "not known",
    )

    stored: dict[str, int] = Field(
        {},
        description="registers that decide what a position means, as the servo had them when "
        "zero_ticks was measured, by name; absent: as from the factory",
    )

    @field_validator("model")
    @classmethod
    def _check_model(cls, value: str) -> str:
        if value not in models():
            raise ValueError("one of " + ", ".join(models()))
        return value

    @field_validator("upper")
    @classmethod
    def _check_order(cls, value: float, info: ValidationInfo) -> float:
        if value <= info.data.get("lower", -math.inf):
            raise ValueError(f"above lower ({info.data['lower']})")
        return value

    @model_validator(mode="after")
    def _check_transmission(self) -> JointConfig:
        given = (self.pinion_radius_m is not None) + (self.screw_lead_m is not None)
        if given != (self.type == "prismatic"):
            allowed = (
                "exactly one of screw_lead_m and pinion_radius_m"
                if self.type == "prismatic"
                else "no screw_lead_m or pinion_radius_m at a revolute joint"
            )
            raise Misdeclared("pinion_radius_m", self.pinion_radius_m, allowed)
        return self

    @model_validator(mode="after")
    def _check_registers(self) -> JointConfig:
        known = [r.name for r in protocols()[self.servo.protocol].registers if r.places]
        for name, value in self.stored.items():
            if name not in known:
                allowed = f"of a {self.model}: {', '.join(known) or 'none'}"
                raise Misdeclared(f"stored.{name}", value, allowed)
        return self

    @model_validator(mode="after")
    def _check_zero(self) -> JointConfig:
        low, high = self.zero_range(self.direction, self.stored)
        if not low <= self.zero_ticks <= high:
            turn = self.servo.ticks_per_turn
            same = self.zero_ticks - turn * math.floor((self.zero_ticks - low) / turn)
            allowed = (
                f"{math.ceil(low)} to {math.floor(high)}, in the turn from which the servo counts "
                "after power-on: "
            )
            if same <= high:
                allowed += (
                    f"for instance {same:g}, the same place of its horn, if the joint is near "
                    f"{self.home:.4g} {self.unit} at every power-on"
                )
            else:
                allowed += (
                    "set its homing_offset and reversal to 0 with the maker's tool, then `longarm "
                    "servo setup`"
                )
            raise Misdeclared("zero_ticks", self.zero_ticks, allowed)
        return self

    def zero_range(self, direction: int, stored: Mapping[str, int]) -> tuple[float, float]:
        """Return the lowest and highest `zero_ticks` that can be true, half a tick of slack added.

        With many turns, the servo counts from one turn after power-on, and it stands in that turn
        while the joint is at `home`.

        Args:
            direction: +1 or -1, of the joint.
            stored: registers of the servo that decide what a position means.
        """
        if not self.multi_turn:
            return -math.inf, math.inf
        low, high = self.turn_at_power_on(stored)
        above = direction * self.home / self.si_per_tick
        return low - above - 0.5, high - above + 0.5

    def turn_at_power_on(self, stored: Mapping[str, int]) -> tuple[int, int]:
        """Return the lowest and highest reading of a servo for many turns at power-on, ticks.

        Only what it reads there in any case: see `Dialect.turn_at_power_on`.
        """
        return protocols()[self.servo.protocol]().turn_at_power_on(self.servo, stored)

    @property
    def home(self) -> float:
        """The joint value 0, or the limit nearest to it, rad or m."""
        return min(max(0.0, self.lower), self.upper)

    @property
    def servo(self) -> ServoModel:
        return models()[self.model]

    @property
    def unit(self) -> str:
        return "m" if self.type == "prismatic" else "rad"

    @property
    def si_per_tick(self) -> float:
        """Motion of the joint, rad or m, for one encoder tick; always positive."""
        per_turn = 2.0 * math.pi
        if self.screw_lead_m is not None:
            per_turn = self.screw_lead_m
        elif self.pinion_radius_m is not None:
            per_turn = 2.0 * math.pi * self.pinion_radius_m
        return per_turn / (self.gear_ratio * self.servo.ticks_per_turn)

    def stands_at(self, step: float) -> bool:
        """Tell whether the servo can stand at every multiple of ``step``, rad or m.

        The error may be up to 0.15 of a step over the range of the joint.
        """
        ticks = step / self.si_per_tick
        farthest = max(abs(self.lower), abs(self.upper)) / step
        drift = abs(ticks - round(ticks)) * farthest
        beside = abs(self.zero_ticks - round(self.zero_ticks))
        # Largest error, as a share of a step
        return round(ticks) >= 1 and drift + beside <= 0.15 * ticks

    @property
    def absolute(self) -> bool:
        """Tell whether a reading alone tells where the joint stands.

        It does if the servo reads within one turn, and this is one turn of the joint.
        """
        return not self.multi_turn and self.type == "revolute" and self.gear_ratio == 1.0

    @property
    def goal_range(self) -> tuple[int, int]:
        """Lowest and highest goal that the servo accepts, ticks."""
        return self.servo.multi_turn if self.multi_turn else self.servo.single_turn

    @cached_property
    def tick_limits(self) -> tuple[int, int]:
        """Lowest and highest goal within the joint's limits, ticks, rounded inwards."""
        ends = sorted(self.exact_ticks(limit) for limit in (self.lower, self.upper))
        return math.ceil(ends[0] - 1e-9), math.floor(ends[1] + 1e-9)

    def check_inside(self, value: float, where: str, field: str) -> None:
        """Raise InputError for a joint value, rad or m, more than half a tick beyond the limits.

        ``where`` and ``field`` name the source of the value.
        """
        slack = 0.5 * self.si_per_tick
        if not self.lower - slack <= value <= self.upper + slack:
            allowed = f"{self.lower:g} to {self.upper:g} {self.unit}"
            raise InputError(where, field, value, allowed)

    def nearest_within_limits(self, ticks: float) -> int:
        """Return the goal, ticks, within the joint's limits that is nearest to ``ticks``."""
        low, high = self.tick_limits
        return min(max(round(ticks), low), high)

    def to_ticks(self, value: float) -> int:
        """Return the goal, ticks, that is nearest to a joint value, rad or m.

        Raises:
            InputError: the value is outside the limits.
        """
        self.check_inside(value, f"servo {self.servo_id}", "position")
        return self.nearest_within_limits(self.exact_ticks(value))

    def to_si(self, ticks: float) -> float:
        """Return the joint value (rad or m) of an encoder reading in ticks."""
        return self.direction * (ticks - self.zero_ticks) * self.si_per_tick

    def speed_to_si(self, ticks_s: float) -> float:
        """Return the joint velocity (rad/s or m/s) of an encoder speed in ticks/s."""
        return self.direction * ticks_s * self.si_per_tick

    def effort_to_si(self, load: float) -> float:
        """Return the effort at the joint, N m or N; NaN if full effort is not configured.

        ``load``: signed share of the servo's full effort.
        """
        return math.nan if self.full_effort is None else self.direction * load * self.full_effort

    @property
    def max_speed_ticks_s(self) -> float:
        return self.max_velocity / self.si_per_tick

    @property
    def fastest_ticks_s(self) -> float:
        """Highest speed of the servo without load, ticks/s; infinite if it is not known."""
        return self.top_speed_ticks_s or self.servo.top_speed_ticks_s or math.inf

    def with_values(self, **values: object) -> JointConfig:
        """Return a checked copy of the joint with the given fields replaced."""
        return JointConfig.model_validate(self.model_dump() | values)

    def exact_ticks(self, value: float) -> float:
        """Return the encoder reading, ticks with fractions, at a joint value, rad or m."""
        return self.zero_ticks + self.direction * value / self.si_per_tick
