"""Setup of servos by a person: reads a held pose with the torque off, then makes small moves."""

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
"""Time between two readings, s."""
_LOOKS, _STILL_TICKS = 15, 8
"""Number of readings of a held pose, and their largest difference, because a hand trembles."""
_NEAR_TICKS, _SETTLED_S, _PATIENCE_S = 6, 0.3, 5.0
"""A move is over when the servo has rested this near its goal for this time, s; or so long, s,
after it was led to its goal."""
_LONGEST_STEP_S, _ASIDE_TICKS = 0.1, 24
"""Longest time by which a goal moves on at once, and how far a servo may be off the way on which it
is led: 2 degrees of its horn, for a gear that gives way."""


def show_value(joint: JointConfig, value: float) -> str:
    """Write a joint value, rad or m, in deg or mm."""
    scale, unit = hand_unit(joint)
    return f"{value / scale:.1f} {unit}"


def hand_unit(joint: JointConfig) -> tuple[float, str]:
    """Return the unit in which joint values are typed: its size in rad or m, and its name."""
    return (1e-3, "mm") if joint.type == "prismatic" else (math.radians(1.0), "deg")


def zero_from_pose(joint: JointConfig, direction: int, ticks: float, value: float) -> float:
    """Return whole ticks at joint value 0, for a reading of ``ticks`` at ``value`` (rad, m)."""
    return float(round(ticks - direction * value / joint.si_per_tick))


def describe_power_on(joints: Mapping[str, JointConfig]) -> str:
    """Say what to do about servos that count from another turn than that of their zero."""
    at = [
        f"{name} at {show_value(joint, joint.home)}, less than "
        f"{show_value(joint, joint.servo.ticks_per_turn / 2 * joint.si_per_tick)} off"
        for name, joint in joints.items()
    ]
    return (
        "the turns that servos have counted contradict the pose: cut the servos' power and give it "
        f"back with {'; '.join(at)} (if they do so again, --pose, --direction or gearing is wrong, "
        "or homing_offset or reversal has to be set to 0 with the maker's tool)"
    )


class ServoSetup:
    """Servos of an arm that a person holds. The torque is off until `hold` is called.

    Args:
        joints: configuration of each joint, by name.
        journal: of the arm; changes of the servos' settings are entered there.
        check: called before anything is held or moved; raises an error if it must not be.

    Attributes:
        memory: stored settings of each joint's servo.
        said: messages for the user about changed settings.
    """

    def __init__(
        self,
        bus: SerialServoBus,
        joints: Mapping[str, JointConfig],
        journal: SetupJournal,
        check: Callable[[], object] = lambda: None,
    ) -> None:
        self._bus, self._joints, self._journal, self._check = bus, joints, journal, check
        self._ids = [joint.servo_id for joint in joints.values()]
        self.memory: dict[str, ServoMemory] = {}
        self.said: list[str] = []

    @contextmanager
    def safely(self) -> Iterator[ServoSetup]:
        """Set the servos for one turn or many as configured; always end with the torque off.

        At the end the old settings are written back unless `keep` was called, also those from
        before an earlier setup that was killed.

        Raises:
            ServoBusError: torque off was not confirmed at the start.
            JobError: a servo has an alarm, or its stored settings do not allow to command it; or at
                the end the torque may still be on, or old settings could not be written back.
        """
        try:
            self._bus.torque(self._ids, on=False)
            self._journal.write_back(self._bus)  # else a change of the file since would lose it
            alarms, kept = self._bus.alarms(self._ids), self._bus.memory(self._ids)
            for name, joint in self._joints.items():
                if alarm := alarms.get(joint.servo_id):
                    who = f"servo {joint.servo_id} of {name}"
                    raise JobError(f"{who} reports {alarm}: remove the cause")
                check_memory(name, joint, kept[joint.servo_id])
            many = {joint.servo_id: joint.multi_turn for joint in self._joints.values()}
            self.said = self._journal.describe_others()
            self.said += self._bus.set_turns(many, self._journal.begin)
            kept = self._bus.memory(self._ids)
            self.memory = {name: kept[joint.servo_id] for name, joint in self._joints.items()}
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
                    "servos have not stored again what they had: the next `longarm servo setup` of "
                    "this arm sees to it",
                    ids=sorted(left),
                    file=self._journal.path,
                )

    def keep(self) -> None:
        """Keep the new settings of the servos: the old ones are not written back at the end."""
        self._journal.end(self._ids)

    def let_go(self) -> None:
        """Switch the torque off."""
        self._bus.torque(self._ids, on=False)

    def hold(self) -> None:
        """Switch the torque on; every servo holds its present position."""
        self._check()
        self._bus.torque(self._ids, on=True)

    def rest(self) -> dict[str, float]:
        """Return the median position of every joint's servo, ticks, in a pose that is held still.

        Raises:
            JobError: a joint moves, or its servo stands beyond its own limits.
        """
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
            +1 if the ticks grew, else -1. The move is upwards unless it would leave the range.

        Raises:
            JobError: there is no room for the move, or the joint does not follow or come back.
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
        left = self._read_ticks(joint) - start
        if abs(left) > _ASIDE_TICKS:
            raise JobError(
                f"{name} did not come back from its small move: servo {joint.servo_id} stands "
                f"{left} ticks from where it began, with {kept.notable}"
            )

    def _go_to(self, name: str, goal: int) -> None:
        """Lead one servo slowly to a goal, ticks, until it rests there or the time is over.

        The goal moves in small steps, so that a servo that ignores the speed moves slowly too. The
        torque of one that leaves the way on which it is led is switched off.
        """
        self._check()
        joint = self._joints[name]
        # Speed of a nudge: 5 deg/s or mm/s at most, so that a person sees it and can step away
        speed = min(5.0 * hand_unit(joint)[0], joint.max_velocity) / joint.si_per_tick
        start = last = self._read_ticks(joint)
        far, led = abs(goal - start), 0.0
        before = rested = time.monotonic()
        limit = before + _PATIENCE_S
        while (now := time.monotonic()) < limit:
            limit = now + _PATIENCE_S if led < far else limit
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
