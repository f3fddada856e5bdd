"""Checks whether the read-back of the servos is plausible and follows the goals."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoState
from longarm_comp.devices.servo_config import FollowerConfig, JointConfig, ServoConfig


class ServoTrouble(Enum):
    """Kinds of servo faults. Each of them stops the arm."""

    SILENT = "silent"
    ALARM = "alarm"
    SUPPLY = "badly supplied"
    OVERHEATED = "overheated"
    STALLED = "stalled"
    NOT_FOLLOWING = "not following"
    LET_GO = "not driven"


@dataclass(frozen=True)
class JointFault:
    trouble: ServoTrouble
    joint: str
    message: str


@dataclass
class _Seen:
    """Last read-back of one servo, and since when it is off its goal."""

    state: ServoState | None = None  # the last trusted read-back
    said: int | None = None  # position of the last read-back, trusted or not, ticks
    ill: tuple[JointFault, ...] = ()  # alarm and temperature faults of the last plausible read-back
    at: float = 0.0  # time of `state`, monotonic s
    off_since: float | None = None  # since when it pushes off its goal, s of watched time
    lost_since: float | None = None  # since when it is far from its goal, s of watched time


class ServoWatch:
    """Keeps the last trusted read-back of every joint and finds faults in it."""

    def __init__(self, config: ServoConfig) -> None:
        self._config = config
        self._seen = {name: _Seen() for name in config.joints}
        self._started: float | None = None
        self._now = self._watched_s = 0.0
        self._goals_before: Mapping[int, int] | None = None

    def update(
        self, now: float, states: Mapping[int, ServoState], goals: Mapping[int, int] | None
    ) -> tuple[bool, list[JointFault]]:
        """Process one read-back of all servos.

        An alarm or too high a temperature is a fault only if the next read-back confirms it,
        because one damaged reply in 256 passes its checksum.  Until then the servo is doubtful.

        A servo may stand anywhere between the last two goals, because the last may have been sent
        just now.  A late cycle counts as `max_step_s` at most, so that few readings of a moving arm
        make no fault.

        Args:
            now: monotonic time, s.
            states: read-back by servo id, of the servos that answered.
            goals: last goals, ticks by servo id; None if nothing was commanded.

        Returns:
            Whether every joint had a trusted read-back this time, and the faults found.
        """
        if self._started is None:
            self._started = self._now = now
        self._watched_s += min(now - self._now, self._config.follower.max_step_s)
        self._now = now
        last_two, self._goals_before = (self._goals_before, goals), goals
        findings: list[JointFault] = []
        fresh = True
        for name, joint in self._config.joints.items():
            seen = self._seen[name]
            state = states.get(joint.servo_id)
            goal = None if goals is None else goals.get(joint.servo_id)
            if state is None or self._is_doubtful(seen, joint, state, now, goal):
                fresh = False
            else:
                before, seen.ill = seen.ill, tuple(self._find_ill(name, joint, state))
                if seen.ill and not before:
                    fresh = False
                else:
                    seen.state, seen.at = state, now
                    findings += seen.ill
            sent = [g.get(joint.servo_id) for g in last_two if g is not None]
            findings += self._find_disobedience(name, joint, seen, sent)
            findings += self._find_silent(name, seen, now)
        return fresh, findings

    def find_standing_faults(self, now: float) -> list[JointFault]:
        """Return the present faults that depend on no command: silence, alarm, temperature."""
        findings: list[JointFault] = []
        for name, seen in self._seen.items():
            findings += self._find_silent(name, seen, now)
            findings += seen.ill
        return findings

    def state(self, joint: str) -> ServoState | None:
        """Return the last trusted read-back of a joint; None before the first."""
        return self._seen[joint].state

    def was_heard(self, joint: str) -> bool:
        """Tell whether a joint had a trusted read-back in the last update."""
        seen = self._seen[joint]
        return seen.state is not None and seen.at == self._now

    def forget_errors(self) -> None:
        """Restart the stall timers, after a reset."""
        for seen in self._seen.values():
            seen.off_since = seen.lost_since = None

    def _is_doubtful(
        self, seen: _Seen, joint: JointConfig, state: ServoState, now: float, goal: int | None
    ) -> bool:
        """Tell whether a read-back is not plausible after the last trusted one.

        A joint cannot have moved faster than four times its highest speed. A step of more than half
        a turn may also be a lost count of turns. It is plausible only on the way to the goal, and
        only if a whole turn would lead off this way. Without a command the joint may be moved by
        hand: then two read-backs that agree are trusted.
        """
        jump = self._config.follower.jump_ticks
        said, seen.said = seen.said, state.position_ticks
        if seen.state is None:
            return False
        was, at, turn = seen.state.position_ticks, state.position_ticks, joint.servo.ticks_per_turn
        fastest = 4.0 * joint.max_speed_ticks_s * (now - seen.at) + jump
        if abs(at - was) <= min(fastest, 0.5 * turn):
            return False
        if goal is not None and abs(at - was) <= fastest and abs(goal - was) + 2.0 * jump < turn:
            return not min(was, goal) - jump <= at <= max(was, goal) + jump
        return goal is not None or said is None or abs(at - said) > jump

    def _find_silent(self, name: str, seen: _Seen, now: float) -> Iterator[JointFault]:
        since = seen.at if seen.state is not None else self._started
        if since is not None and now - since > self._config.follower.silence_s:
            message = f"no trusted reading for {now - since:.2f} s"
            yield JointFault(ServoTrouble.SILENT, name, message)

    def _find_ill(self, name: str, joint: JointConfig, state: ServoState) -> Iterator[JointFault]:
        if state.error_flags:
            supply = state.error_flags is ServoAlarm.VOLTAGE
            trouble = ServoTrouble.SUPPLY if supply else ServoTrouble.ALARM
            yield JointFault(trouble, name, f"the servo reports {state.error_flags.words}")
        if not state.temperature_c <= joint.max_temperature_c:
            hot = f"{state.temperature_c:.0f} C, allowed {joint.max_temperature_c:.0f} C"
            yield JointFault(ServoTrouble.OVERHEATED, name, hot)

    def _find_disobedience(
        self, name: str, joint: JointConfig, seen: _Seen, sent: list[int | None]
    ) -> Iterator[JointFault]:
        """Find a joint that is stalled, or too far from the last two goals (``sent``, ticks)."""
        goals = [goal for goal in sent if goal is not None]
        if len(goals) < 2 or seen.state is None:
            seen.off_since = seen.lost_since = None
            return
        limits, now = self._config.follower, self._watched_s
        at = seen.state.position_ticks
        off = max(min(goals) - at, at - max(goals), 0)
        pushing = off > limits.stall_error_ticks and abs(seen.state.load) >= joint.max_load
        seen.off_since = _begin_since(seen.off_since, pushing, now)
        lost = limits.lost_error_ticks
        if joint.max_error is not None:
            lost = joint.max_error / joint.si_per_tick
        seen.lost_since = _begin_since(seen.lost_since, off > lost, now)
        where = (
            f"{off * joint.si_per_tick:.4g} {joint.unit} off its goal for {limits.stall_time_s} s"
        )
        if seen.off_since is not None and now - seen.off_since >= limits.stall_time_s:
            load = f"{where} at {abs(seen.state.load):.0%} load"
            yield JointFault(ServoTrouble.STALLED, name, load)
        elif seen.lost_since is not None and now - seen.lost_since >= limits.stall_time_s:
            yield JointFault(ServoTrouble.NOT_FOLLOWING, name, where)


STILL_TICKS_S = 30.0
"""Speed below which a servo counts as standing still, ticks/s."""


def stands_in_its_droop(
    state: ServoState, goal: int, joint: JointConfig, limits: FollowerConfig
) -> bool:
    """Tell whether a driven servo rests away from its goal only because of its load (droop).

    Such a servo would sink if its present position became its goal. The answer is no for a servo
    that pushes against an obstacle or still moves: if it kept its goal, it would move on.

    Args:
        goal: present goal of the servo, ticks.
    """
    off = abs(goal - state.position_ticks)
    pushes = off > limits.stall_error_ticks and abs(state.load) >= joint.max_load
    still = abs(state.velocity_ticks_s) < STILL_TICKS_S
    return still and not pushes and off <= limits.lost_error_ticks


def _begin_since(start: float | None, holds: bool, now: float) -> float | None:
    if not holds:
        return None
    return now if start is None else start
