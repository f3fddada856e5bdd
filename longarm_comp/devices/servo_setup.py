"""Setting up servos by hand: a pose held with the torque off, then small moves under torque."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from statistics import median

from longarm_comp.core.errors import JobError
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.memory import ServoMemory
from longarm_comp.devices.servo_bus.state import ServoBusError
from longarm_comp.devices.servo_check import check_memory
from longarm_comp.devices.servo_joint import JointConfig
from longarm_comp.devices.setup_journal import SetupJournal

_PERIOD_S = 0.02
"""Between two readings."""
_LOOKS, _STILL_TICKS = 15, 8
"""Readings of a held pose, and how much they may differ: a hand trembles."""
_NEAR_TICKS, _SETTLED_S = 6, 0.3
"""A move is over where the servo rests so near its goal for so long."""
_LONGEST_STEP_S, _ASIDE_TICKS = 0.1, 24
"""Longest time by which a goal moves on at once, and how far beside the way led a servo may be:
2 degrees of its horn, for a gear that gives way."""


def show_value(joint: JointConfig, value: float) -> str:
    """Write a joint value, rad or m, in deg or mm."""
    scale, unit = hand_unit(joint)
    return f"{value / scale:.1f} {unit}"


def hand_unit(joint: JointConfig) -> tuple[float, str]:
    """Return the unit in which joint values are typed: its size in rad or m, and its name."""
    return (1e-3, "mm") if joint.type == "prismatic" else (math.radians(1.0), "deg")


def zero_from_pose(joint: JointConfig, ticks: float, value: float) -> float:
    """Return whole ticks at joint value 0, for a reading of ``ticks`` at ``value`` (rad, m)."""
    return float(round(ticks - joint.direction * value / joint.si_per_tick))


class ServoSetup:
    """Servos of an arm in the operator's hands. The torque is off unless it is switched on.

    Attributes:
        memory: what each joint's servo has stored. said: what was changed there, to be told.

    Args:
        check: called before anything is held or moved; raises where it must not be.
    """

    def __init__(
        self,
        bus: SerialServoBus,
        joints: Mapping[str, JointConfig],
        check: Callable[[], object] = lambda: None,
    ) -> None:
        self._bus, self._joints, self._check = bus, joints, check
        self._ids = [joint.servo_id for joint in joints.values()]
        self._journal = SetupJournal(bus.port, bus.protocol)
        self.memory: dict[str, ServoMemory] = {}
        self.said: list[str] = []

    @contextmanager
    def safely(self) -> Iterator[ServoSetup]:
        """Set one or many turns as declared; switch the torque off at the end, whatever happens.

        What the servos had stored, also before an earlier setup that was killed, is written back at
        the end, unless `keep` was called.

        Raises:
            ServoBusError: torque off was not confirmed at the start.
            JobError: a servo has an alarm, or must not be commanded by what it has stored; or the
                torque may still be on at the end, or something could not be written back.
        """
        try:
            self._bus.torque(self._ids, on=False)
            self._check_memory()
            self._set_turns()
            yield self
        finally:
            try:
                self._bus.torque(self._ids, on=False)
            except ServoBusError as error:
                raise JobError(
                    "the torque may be on: cut the power of the servos", why=str(error)
                ) from error
            left = set(self._journal.write_back(self._bus)) & set(self._ids)
            if left:
                raise JobError(
                    "servos have not stored again what they had: the next `longarm servo setup` on "
                    "this port sees to it",
                    ids=sorted(left),
                    file=self._journal.path,
                )

    def _check_memory(self) -> None:
        """Refuse servos with an alarm, or whose memory gives commands another meaning."""
        alarms, kept = self._bus.alarms(self._ids), self._bus.memory(self._ids)
        for name, joint in self._joints.items():
            if alarm := alarms.get(joint.servo_id):
                who = f"servo {joint.servo_id} of {name}"
                raise JobError(f"{who} reports {alarm}: remove the cause")
            check_memory(name, joint, kept[joint.servo_id])

    def _set_turns(self) -> None:
        many = {j.servo_id: j.multi_turn for j in self._joints.values()}
        self.said = self._bus.set_turns(many, self._journal.begin)
        kept = self._bus.memory(self._ids)
        self.memory = {name: kept[joint.servo_id] for name, joint in self._joints.items()}

    def keep(self) -> None:
        """Keep what the servos have stored, instead of writing back the old values at the end."""
        self._journal.end(self._ids)

    def let_go(self) -> None:
        """Switch the torque off."""
        self._bus.torque(self._ids, on=False)

    def hold(self) -> None:
        """Switch the torque on; every servo stays where it is."""
        self._check()
        self._bus.torque(self._ids, on=True)

    def rest(self) -> dict[str, float]:
        """Read the ticks of every joint's servo in a pose that is held still."""
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
            if why := self.memory[name].describe_jump(at[name]):
                raise JobError(f"servo {joint.servo_id} of {name} {why}")
        return at

    @contextmanager
    def nudge(self, name: str) -> Iterator[int]:
        """Move one joint by 5 degrees or 5 mm, and back at the end of the context.

        Yields:
            +1 where the ticks grew: it goes up unless that leads out of the servo's range.
        """
        joint, kept = self._joints[name], self.memory[name]
        start = self._read_ticks(joint)
        ticks = max(round(5.0 * hand_unit(joint)[0] / joint.si_per_tick), 4 * _NEAR_TICKS)
        low, high = kept.goals or joint.goal_range
        way = 1 if start + ticks <= high else -1
        if start + way * ticks < low:
            raise JobError(
                f"servo {joint.servo_id} of {name} stands at {start} and takes goals {low} to "
                f"{high}: no room for a move of {ticks} ({kept.changes})"
            )
        self._go_to(name, start + way * ticks)
        moved = self._read_ticks(joint) - start
        if abs(moved) < ticks / 2:
            what = f"{name} does not move: servo {joint.servo_id}, with {kept.notable}"
            raise JobError(what, ticks=moved)
        yield 1 if moved > 0 else -1
        self._go_to(name, start)

    def _go_to(self, name: str, goal: int) -> None:
        """Lead one servo to a goal, until it rests there or a while has passed.

        The goals creep, so that a servo that takes no notice of the speed is slow too. One that is
        not on the way that was led so far is let go.
        """
        self._check()
        joint = self._joints[name]
        # Speed of a nudge, deg/s or mm/s: to be seen, and to be stepped away from
        speed = min(5.0 * hand_unit(joint)[0], joint.max_velocity) / joint.si_per_tick
        start = last = self._read_ticks(joint)
        far, led = abs(goal - start), 0.0
        before = rested = time.monotonic()
        # With a move: times one second and the time that it takes
        limit = before + 3.0 * (1.0 + far / speed)
        while (now := time.monotonic()) < limit:
            led = min(far, led + speed * min(now - before, _LONGEST_STEP_S))
            before = now
            sent = start + round(math.copysign(led, goal - start))
            self._bus.write_goal({joint.servo_id: sent}, {joint.servo_id: speed})
            at = self._read_ticks(joint)
            if not min(start, sent) - _ASIDE_TICKS <= at <= max(start, sent) + _ASIDE_TICKS:
                self._bus.torque([joint.servo_id], on=False)
                raise JobError(
                    f"servo {joint.servo_id} of {name} does not move as slowly as asked, or not to "
                    f"where it is sent: stopped, its torque is off ({self.memory[name].changes})",
                    from_ticks=start,
                    sent=sent,
                    at=at,
                )
            if abs(at - last) > 1:
                rested, last = now, at
            if abs(at - goal) <= _NEAR_TICKS and now - rested > _SETTLED_S:
                return
            time.sleep(_PERIOD_S)

    def _read_ticks(self, joint: JointConfig) -> int:
        return self._bus.read([joint.servo_id])[joint.servo_id].position_ticks
