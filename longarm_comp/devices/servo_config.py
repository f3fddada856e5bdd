"""Configuration of the servos and the joints they drive, read from YAML and checked.

Keys are ``bus`` (the port), ``joints`` (one entry per joint, in the order of the arm) and
``follower`` (limits of the trajectory follower). Joint values are in rad (revolute) or m
(prismatic); other units are in the names of the keys. A ROS parameter file with these keys under
``ros__parameters`` can be read too.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator

from longarm_comp.core.errors import InputError
from longarm_comp.core.yaml_file import Misdeclared, parse_declared, read_yaml
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.registry import models, open_bus, protocols
from longarm_comp.devices.servo_bus.state import ServoModel
from longarm_comp.devices.servo_joint import JointConfig, Positive, ServoSettings

_ROUNDED = 1.0 + 1e-6
"""Factor by which a value may exceed another one because of rounding."""


class BusConfig(ServoSettings):
    """The serial line."""

    protocol: str = Field(description="of the servos")
    port: str = Field(description="serial device")
    baudrate: int = Field(1_000_000, gt=0, description="bits a second")
    reply_timeout_s: float = Field(0.02, gt=0.0, le=1.0, description="longest wait for a reply, s")
    retries: int = Field(
        2, ge=0, le=10, description="repetitions of an instruction without a good reply"
    )

    @field_validator("protocol")
    @classmethod
    def _check_protocol(cls, value: str) -> str:
        if value not in protocols():
            raise ValueError("one of " + ", ".join(protocols()))
        return value


class FollowerConfig(ServoSettings):
    """Limits for every joint. Ticks are encoder ticks of the servo, at most half a turn.

    Times that guard against a fault may be a few seconds at most, so that a value given in ms by
    mistake is refused.
    """

    blend_s: Positive = Field(
        default=0.2,
        le=2.0,
        description="time in which a new trajectory takes over from a running one, s",
    )
    max_step_s: Positive = Field(
        default=0.1,
        le=1.0,
        description="longest time by which the goal moves on at once, also after a pause, s",
    )
    silence_s: Positive = Field(
        default=0.25, le=5.0, description="time without a trusted reading that is a fault, s"
    )
    stall_error_ticks: Positive = Field(
        default=40.0, description="position error at full load that counts as a stall"
    )
    stall_time_s: Positive = Field(
        default=0.5, le=5.0, description="time that it must last to be a stall, s"
    )
    lost_error_ticks: Positive = Field(
        default=400.0, description="position error over stall_time_s that is a fault at any load"
    )
    jump_ticks: Positive = Field(
        default=200.0, description="a reading this far from any reachable position is rejected"
    )
    trim_ticks: Positive = Field(
        default=100.0,
        description="largest correction by trim, and largest distance beyond its limit at which "
        "a joint is still accepted at the start",
    )
    trim_pause_s: Positive = Field(
        default=0.12,
        le=60.0,
        description="rest between two corrections of trim, a period of the slowest swing, s",
    )


def _check_turns(where: str, joint: JointConfig, off_ticks: float) -> None:
    """Refuse limits that the servo cannot reach, or near which its encoder jumps within one turn.

    A servo that rests up to ``off_ticks`` from its goal, past the jump, would turn round to it the
    other way.
    """
    (low, high), away = joint.goal_range, 0.0 if joint.multi_turn else off_ticks
    ticks = [joint.exact_ticks(limit) for limit in (joint.lower, joint.upper)]
    for field, at in zip(("lower", "upper"), ticks, strict=True):
        if low + away - 0.5 <= at <= high - away + 0.5:
            continue
        ends = sorted((joint.to_si(low + away), joint.to_si(high - away)))
        allowed = f"{ends[0]:.6g} to {ends[1]:.6g} {joint.unit} in its turns"
        if not joint.multi_turn:
            allowed += f", {away:g} ticks (stall_error_ticks) from where the encoder jumps"
            middle, reads = (low + high) / 2, sum(ticks) / 2
            if abs(ticks[1] - ticks[0]) <= high - low - 2.0 * away:
                allowed += f"; mount the horn so that the middle of the range reads {middle:.0f}, "
                allowed += f"not {reads:.0f}, or"
            else:
                allowed += ";"
            allowed += " multi_turn: true gives more turns"
        raise Misdeclared(f"{where}.{field}", getattr(joint, field), allowed)


class ServoConfig(ServoSettings):
    """Configuration of all servos of an arm; ``joints`` keeps the order of the file."""

    bus: BusConfig
    joints: dict[str, JointConfig] = Field(min_length=1)
    follower: FollowerConfig = FollowerConfig()

    @model_validator(mode="after")
    def _check_joints(self) -> ServoConfig:
        owner: dict[int, str] = {}
        for name, joint in self.joints.items():
            where = f"joints.{name}"
            other = owner.setdefault(joint.servo_id, name)
            if other != name:
                raise Misdeclared(
                    f"{where}.servo_id", joint.servo_id, f"an id that {other} does not use"
                )
            if joint.servo.protocol != self.bus.protocol:
                known = [m.name for m in models().values() if m.protocol == self.bus.protocol]
                raise Misdeclared(f"{where}.model", joint.model, "one of " + ", ".join(known))
            _check_turns(where, joint, self.follower.stall_error_ticks)
            if joint.max_speed_ticks_s > joint.fastest_ticks_s * _ROUNDED:
                top = f"{joint.fastest_ticks_s * joint.si_per_tick:.4g} {joint.unit}/s"
                allowed = f"at most {top}, as fast as a {joint.model} moves it; "
                allowed += "top_speed_ticks_s where this servo is faster"
                raise Misdeclared(f"{where}.max_velocity", joint.max_velocity, allowed)
            half_turn = joint.servo.ticks_per_turn / 2 * joint.si_per_tick
            if joint.max_error is not None and joint.max_error > half_turn * _ROUNDED:
                allowed = f"at most {half_turn:.4g} {joint.unit}, half a turn of the servo"
                raise Misdeclared(f"{where}.max_error", joint.max_error, allowed)
            if joint.tick_limits[0] > joint.tick_limits[1]:
                raise Misdeclared(
                    f"{where}.upper", joint.upper, "at least one encoder tick above lower"
                )
        self._check_durations()
        # With limits beyond half a turn, a servo that stands still or lost a turn would pass
        half = min(joint.servo.ticks_per_turn for joint in self.joints.values()) / 2
        for field, value in self.follower:
            if field.endswith("_ticks") and value > half:
                allowed = f"at most {half:g}, half a turn of the servo"
                raise Misdeclared(f"follower.{field}", value, allowed)
        return self

    def _check_durations(self) -> None:
        """Refuse durations that contradict each other."""
        bus, limits = self.bus, self.follower
        longest = limits.silence_s / (1 + bus.retries)
        if bus.reply_timeout_s > longest * _ROUNDED:
            allowed = f"at most {longest:.4g} with {bus.retries} retries: no fault can be found "
            allowed += f"before a read ends, and silence_s is {limits.silence_s:g}"
            raise Misdeclared("bus.reply_timeout_s", bus.reply_timeout_s, allowed)
        for field in ("silence_s", "stall_time_s"):  # else one late cycle would be a fault
            most = getattr(limits, field)
            if limits.max_step_s > most * _ROUNDED:
                allowed = f"at most {field}, {most:g}"
                raise Misdeclared("follower.max_step_s", limits.max_step_s, allowed)

    def check_rate(self, rate_hz: float, where: str) -> None:
        """Refuse too few cycles a second for the follower: InputError, which names ``where``."""
        limits = self.follower
        for field, most in (("max_step_s", limits.max_step_s), ("blend_s", limits.blend_s / 2)):
            if rate_hz * most * _ROUNDED < 1.0:
                cycles = "a cycle within" if field == "max_step_s" else "two cycles within"
                said = f"{cycles} follower.{field}, {getattr(limits, field):g}"
                raise InputError(where, "rate_hz", rate_hz, f"at least {1.0 / most:.4g}: {said}")

    @property
    def models(self) -> dict[int, ServoModel]:
        return {joint.servo_id: joint.servo for joint in self.joints.values()}

    @property
    def ids(self) -> dict[str, int]:
        """Servo id by joint name, in the order of the file."""
        return {name: joint.servo_id for name, joint in self.joints.items()}

    def open_bus(self) -> SerialServoBus:
        """Open the port. Raises BusUnplugged."""
        bus = self.bus
        return open_bus(
            bus.protocol, bus.port, bus.baudrate, self.models, bus.reply_timeout_s, bus.retries
        )

    def free_servos(self) -> None:
        """Switch the torque of all servos off, without checking their models or settings.

        Raises:
            BusUnplugged, IncompleteReply, ServoFault: not every servo confirmed it.
        """
        bus = self.open_bus()
        try:
            bus.torque(list(self.ids.values()), on=False)
        finally:
            bus.close()

    @classmethod
    def load(cls, path: str | Path) -> ServoConfig:
        """Read a YAML file, plain or as ROS parameters. Raises InputError naming the field."""
        return cls.parse(read_yaml(path), str(path))

    @classmethod
    def parse(cls, data: Any, where: str) -> ServoConfig:
        """Check nested mappings; ``where`` names the source. Raises InputError naming the field.

        In the content of a ROS parameter file, all other parameters are ignored.
        """
        if isinstance(data, Mapping) and len(data) == 1:
            (node,) = data.values()
            if isinstance(node, Mapping) and "ros__parameters" in node:
                params = node["ros__parameters"] or {}
                data = {key: params[key] for key in cls.model_fields if key in params}
        return parse_declared(cls, data, where)
