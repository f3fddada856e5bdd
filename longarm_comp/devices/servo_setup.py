"""Setting up servos by hand: a pose held with the torque off, then small moves under torque."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from statistics import median

from longarm_comp.core.errors import JobError
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.state import ServoBusError
from longarm_comp.devices.servo_joint import JointConfig

_PERIOD_S = 0.02
"""Between two readings."""
_LOOKS, _STILL_TICKS = 15, 8
"""Readings of a held pose, and how much they may differ: a hand trembles."""
_NEAR_TICKS, _SETTLED_S = 6, 0.3
"""A move is over where the servo rests so near its goal for so long."""


def shown(joint: JointConfig, value: float) -> str:
    """A joint value, rad or m, in deg or mm."""
    scale, unit = hand_unit(joint)
    return f"{value / scale:.1f} {unit}"


def hand_unit(joint: JointConfig) -> tuple[float, str]:
    """Unit in which joint values are typed: its size in rad or m, and its name."""
    return (1e-3, "mm") if joint.type == "prismatic" else (math.radians(1.0), "deg")


def zero_from_pose(joint: JointConfig, ticks: float, value: float) -> float:
    """Whole ticks at joint value 0, where the servo reads ``ticks`` at ``value`` (rad, m)."""
    return float(round(ticks - joint.direction * value / joint.si_per_tick))


class ServoSetup:
    """Servos of an arm in the operator's hands. The torque is off unless it is switched on."""

    def __init__(self, bus: SerialServoBus, joints: Mapping[str, JointConfig]) -> None:
        self._bus, self._joints = bus, joints
        self._ids = [joint.servo_id for joint in joints.values()]

    @contextmanager
    def safely(self) -> Iterator[ServoSetup]:
        """Torque off at the end, whatever happens; the servos keep one or many turns as declared.

        Raises:
            ServoBusError: torque off was not confirmed at the start.
            JobError: it was not at the end.
        """
        try:
            self._bus.torque(self._ids, on=False)
            self._bus.set_turns({j.servo_id: j.multi_turn for j in self._joints.values()})
            yield self
        finally:
            try:
                self._bus.torque(self._ids, on=False)
            except ServoBusError as error:
                raise JobError(
                    "the torque may be on: cut the power of the servos", why=str(error)
                ) from error

    def hold(self) -> None:
        """Torque on; every servo stays where it is."""
        self._bus.torque(self._ids, on=True)

    def rest(self) -> dict[str, float]:
        """Ticks of every joint's servo in a pose that is held still."""
        looks = []
        for _ in range(_LOOKS):
            looks.append(self._bus.read(self._ids))
            time.sleep(_PERIOD_S)
        at = {}
        for name, joint in self._joints.items():
            ticks = [look[joint.servo_id].position_ticks for look in looks]
            if max(ticks) - min(ticks) > _STILL_TICKS:
                raise JobError(f"{name} moves: hold the arm still", ticks=max(ticks) - min(ticks))
            at[name] = float(median(ticks))
        return at

    @contextmanager
    def nudged(self, name: str) -> Iterator[int]:
        """One joint is 5 degrees or 5 mm away meanwhile.

        Yields:
            +1 where the ticks grew: it goes up unless that leads out of the servo's range.
        """
        joint = self._joints[name]
        start = self._at(joint)
        ticks = max(round(5.0 * hand_unit(joint)[0] / joint.si_per_tick), 4 * _NEAR_TICKS)
        way = 1 if start + ticks <= joint.goal_range[1] else -1
        self._go(joint, start + way * ticks)
        moved = self._at(joint) - start
        if abs(moved) < ticks / 2:
            raise JobError(f"{name} does not move: servo {joint.servo_id}", ticks=moved)
        yield 1 if moved > 0 else -1
        self._go(joint, start)

    def _go(self, joint: JointConfig, goal: int) -> None:
        """Drive one servo to a goal; ends when it rests there, or without it after a while."""
        # Speed of a nudge, deg/s or mm/s: to be seen, and to be stepped away from
        speed = min(5.0 * hand_unit(joint)[0], joint.max_velocity) / joint.si_per_tick
        rested, last = time.monotonic(), self._at(joint)
        # With a move: times one second and the time that it takes
        limit = time.monotonic() + 3.0 * (1.0 + abs(goal - last) / speed)
        while time.monotonic() < limit:
            self._bus.write_goal({joint.servo_id: goal}, {joint.servo_id: speed})
            at = self._at(joint)
            if abs(at - last) > 1:
                rested, last = time.monotonic(), at
            if abs(at - goal) <= _NEAR_TICKS and time.monotonic() - rested > _SETTLED_S:
                return
            time.sleep(_PERIOD_S)

    def _at(self, joint: JointConfig) -> int:
        return self._bus.read([joint.servo_id])[joint.servo_id].position_ticks
