"""Setting up servos by hand: sweep with the torque off, pose at rest, small moves under torque.

Readings belong to a servo id, not to a joint, so that ids can be exchanged afterwards.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.servo_bus import IncompleteReply, SerialServoBus, ServoBusError
from longarm_comp.devices.servo_joint import JointConfig

_PERIOD_S = 0.02
"""Between two readings."""
_LOOKS, _STILL_TICKS = 15, 8
"""Readings of a held pose, and how much they may differ: a hand trembles."""
_UNMOVED_TICKS = 8
"""A servo that was swept over no more than that was not moved."""
_NEAR_TICKS, _SETTLED_S = 6, 0.3
"""A move is over where the servo rests so near its goal for so long."""


@dataclass(frozen=True)
class Travel:
    """Where a servo was during the sweep, ticks, counted on over the end of a turn."""

    low: int
    now: int
    high: int

    def with_reading(self, ticks: int, turn: int | None) -> Travel:
        """After one more reading; ``turn``: ticks after which readings start again at 0."""
        if turn is not None:
            ticks += round((self.now - ticks) / turn) * turn
        return Travel(min(self.low, ticks), ticks, max(self.high, ticks))

    @property
    def span(self) -> int:
        """Ticks between its ends."""
        return self.high - self.low


@dataclass(frozen=True)
class _Nudge:
    """A small move that was made: servo, where from, and how far, ticks."""

    servo_id: int
    start: int
    moved: int

    @property
    def sign(self) -> int:
        """+1 where the ticks grew."""
        return 1 if self.moved > 0 else -1


Sweep = Mapping[int, Travel]
"""Travel by servo id."""


def sweep_faults(name: str, joint: JointConfig, travel: Travel) -> Iterator[str]:
    """What a sweep says against a joint, in words with the remedy."""
    if travel.span <= _UNMOVED_TICKS:
        yield f"{name} did not move: is servo {joint.servo_id} another joint's?"
        return
    top = joint.servo.ticks_per_turn - 1
    if not joint.multi_turn and (travel.low < 0 or travel.high > top):
        yield (
            f"{name}: the encoder of servo {joint.servo_id} jumps from {top} to 0 within the "
            f"travel ({travel.low} to {travel.high}): put its horn on {_shift(travel, top):+d} "
            "ticks further, or set multi_turn: true"
        )


def beyond_travel(name: str, joint: JointConfig, travel: Travel) -> Iterator[str]:
    """Limits of a joint, its zero and direction known, that the sweep did not reach."""
    low, high = joint.tick_limits
    for over in (travel.low - low, high - travel.high):
        if over > _UNMOVED_TICKS:
            size = shown(joint, over * joint.si_per_tick)
            yield (
                f"{name}: its limits reach {size} beyond where it was moved by hand; are they, "
                "the zero and the direction right?"
            )


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


def zero_from_sweep(
    name: str, joint: JointConfig, travel: Travel, stops: tuple[float, float] | None
) -> float:
    """Whole ticks at joint value 0, where the sweep's ends are the joint's stops.

    Args:
        stops: joint values of the mechanical stops, rad or m; None: the declared limits.
    """
    low, high = stops or (joint.lower, joint.upper)
    swept = travel.span * joint.si_per_tick
    # Share of the declared range by which stops met in the sweep may differ from it
    if abs(swept - (high - low)) > 0.05 * (high - low):
        ends = " to ".join(shown(joint, value) for value in (low, high))
        found = f"{name} was swept over {shown(joint, swept)}"
        allowed = (
            f"the way between its stops, {ends}: sweep to both, name the stops with --stops, "
            "correct the gearing, or take the zero from a pose"
        )
        raise InputError("servo setup", "sweep", found, allowed)
    middle = (travel.low + travel.high) / 2
    return zero_from_pose(joint, middle, (low + high) / 2)


class ServoSetup:
    """Servos of an arm in the operator's hands. The torque is off unless it is switched on."""

    def __init__(self, bus: SerialServoBus, joints: Mapping[str, JointConfig]) -> None:
        self._bus = bus
        self.joints = dict(joints)
        self._ids = [joint.servo_id for joint in joints.values()]
        self._turn = {
            joint.servo_id: None if joint.multi_turn else joint.servo.ticks_per_turn
            for joint in joints.values()
        }
        self._sweep: dict[int, Travel] = {}

    @contextmanager
    def safely(self) -> Iterator[ServoSetup]:
        """Torque off at the end, whatever happens; the servos keep one or many turns as declared.

        Raises:
            ServoBusError: torque off was not confirmed at the start.
            JobError: it was not at the end.
        """
        try:
            self.free()
            self._bus.set_turns({j.servo_id: j.multi_turn for j in self.joints.values()})
            yield self
        finally:
            try:
                self.free()
            except ServoBusError as error:
                raise JobError(
                    "the torque may be on: cut the power of the servos", why=str(error)
                ) from error

    def free(self) -> None:
        """Torque off, confirmed."""
        self._bus.torque(self._ids, on=False)

    def hold(self) -> None:
        """Torque on; every servo stays where it is."""
        self._bus.torque(self._ids, on=True)

    def sweep(self, done: Callable[[Sweep, float], bool], seen: Callable[[Sweep], None]) -> Sweep:
        """Read all servos until done; the ends of their travel.

        Args:
            done: given the travels so far and the seconds since a servo last moved.
            seen: told of every reading.

        Raises:
            IncompleteReply: half a second of readings lacked a servo.
        """
        lost, moved = 0, time.monotonic()
        self._sweep = {}
        while True:
            try:
                states, lost = self._bus.read(self._ids), 0
            except IncompleteReply as error:
                states, lost = error.states, lost + 1
                # Readings in a row that may be incomplete: cables move with the arm
                if lost > 25:
                    raise
            before = dict(self._sweep)
            for servo_id, state in states.items():
                at = state.position_ticks
                last = before.get(servo_id, Travel(at, at, at))
                self._sweep[servo_id] = last.with_reading(at, self._turn[servo_id])
                if abs(self._sweep[servo_id].now - last.now) > 1:
                    moved = time.monotonic()
            seen(self._sweep)
            if len(self._sweep) == len(self._ids) and done(self._sweep, time.monotonic() - moved):
                return self._sweep
            time.sleep(_PERIOD_S)

    def rest(self) -> dict[int, float]:
        """Ticks of every servo in a pose that is held still."""
        looks = []
        for _ in range(_LOOKS):
            looks.append({i: s.position_ticks for i, s in self._bus.read(self._ids).items()})
            time.sleep(_PERIOD_S)
        at = {}
        for name, joint in self.joints.items():
            ticks = [look[joint.servo_id] for look in looks]
            if max(ticks) - min(ticks) > _STILL_TICKS:
                raise JobError(f"{name} moves: hold the arm still", ticks=max(ticks) - min(ticks))
            at[joint.servo_id] = float(median(ticks))
        return at

    def nudge(self, name: str, by: float) -> _Nudge:
        """Move one joint by ``by`` (rad, m) one way or the other.

        It goes up unless that leads out of the servo's range or of the travel of the sweep.
        """
        joint = self.joints[name]
        start = self._at(joint.servo_id)
        ticks = max(round(by / joint.si_per_tick), 4 * _NEAR_TICKS)
        low, high = joint.goal_range
        swept = self._sweep.get(joint.servo_id)
        if swept is not None:
            low, high = max(low, swept.low), min(high, swept.high)
        ways = [way for way in (1, -1) if low <= start + way * ticks <= high]
        if not ways:
            raise JobError(
                f"{name} has no room for a nudge of {shown(joint, by)}",
                at=start, travel=[low, high],
            )  # fmt: skip
        self._go(joint.servo_id, start + ways[0] * ticks)
        moved = self._at(joint.servo_id) - start
        if abs(moved) < ticks / 2:
            raise JobError(f"{name} does not move: servo {joint.servo_id}", ticks=moved)
        return _Nudge(joint.servo_id, start, moved)

    def back(self, nudge: _Nudge) -> None:
        """Take a nudge back."""
        self._go(nudge.servo_id, nudge.start)

    def _go(self, servo_id: int, goal: int) -> None:
        """Drive one servo to a goal; ends when it rests there, or without it after a while."""
        joint = next(j for j in self.joints.values() if j.servo_id == servo_id)
        # Speed of a nudge, deg/s or mm/s: to be seen, and to be stepped away from
        speed = min(5.0 * hand_unit(joint)[0], joint.max_velocity) / joint.si_per_tick
        rested, last = time.monotonic(), self._at(servo_id)
        # With a move: times one second and the time that it takes
        limit = time.monotonic() + 3.0 * (1.0 + abs(goal - last) / speed)
        while time.monotonic() < limit:
            self._bus.write_goal({servo_id: goal}, {servo_id: speed})
            at = self._at(servo_id)
            if abs(at - last) > 1:
                rested, last = time.monotonic(), at
            if abs(at - goal) <= _NEAR_TICKS and time.monotonic() - rested > _SETTLED_S:
                return
            time.sleep(_PERIOD_S)

    def exchange(self, one: str, other: str) -> None:
        """Exchange the servos of two joints."""
        a, b = self.joints[one], self.joints[other]
        self.joints[one] = a.having(servo_id=b.servo_id, model=b.model)
        self.joints[other] = b.having(servo_id=a.servo_id, model=a.model)

    def _at(self, servo_id: int) -> int:
        return self._bus.read([servo_id])[servo_id].position_ticks


def _shift(travel: Travel, top: int) -> int:
    """Ticks by which the middle of the travel is off the middle of the turn."""
    return round((top + 1) / 2 - (travel.low + travel.high) / 2)
