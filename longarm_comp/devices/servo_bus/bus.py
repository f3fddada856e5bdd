"""A bus of servos: reads states, sends goals, switches torque. Failures are typed errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

from longarm_comp.devices.servo_bus.dialect import Block, Dialect, Reply
from longarm_comp.devices.servo_bus.errors import (
    IncompleteReply,
    ServoChecksum,
    ServoFault,
    ServoRejected,
    ServoTimeout,
)
from longarm_comp.devices.servo_bus.exchange import Answers, BusCounters, ask
from longarm_comp.devices.servo_bus.port import SerialPort
from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoModel, ServoState


class ServoBus(Protocol):
    """Interface of a servo bus to the driver. :class:`SerialServoBus` implements it."""

    counters: BusCounters

    def ping(self, servo_id: int) -> int:
        """The servo's model number."""

    def read(self, ids: Sequence[int]) -> dict[int, ServoState]:
        """The state of every servo, by id, from one bulk read."""

    def write_goal(
        self, goals: Mapping[int, int], speeds_ticks_s: Mapping[int, float] | None = None
    ) -> None:
        """Send goal positions (ticks), all at once; speed 0 or left out: the servo's maximum."""

    def torque(self, ids: Sequence[int], on: bool) -> None:
        """Switch the drives; switching on holds the servos where they are."""

    def driven(self, ids: Sequence[int]) -> dict[int, bool]:
        """Whether each servo's drive is on."""

    def close(self) -> None:
        """Release the port; torque stays as it is."""


class SerialServoBus:
    """Servos of one protocol on one serial port.

    Args:
        models: model of each servo, by id. Only these ids may be read.
        retries: how often a servo without a usable answer is read again.

    Every method raises :class:`BusUnplugged` when the port goes away. Not thread-safe.
    """

    def __init__(
        self,
        port: SerialPort,
        dialect: Dialect,
        models: Mapping[int, ServoModel],
        retries: int = 2,
    ) -> None:
        self._port = port
        self._dialect = dialect
        self._models = dict(models)
        self._retries = retries
        self.counters = BusCounters()

    def ping(self, servo_id: int) -> int:
        """The servo's model number. Raises ServoTimeout, ServoChecksum."""
        reply = self._fetch([servo_id], self._dialect.model)[servo_id]
        return int.from_bytes(reply.data, "little")

    def read(self, ids: Sequence[int]) -> dict[int, ServoState]:
        """The state of every servo from one sync read.

        Raises:
            ServoTimeout, ServoChecksum: ``answered`` holds the states of those that did answer.
            ServoRejected: a servo refused the read.
        """
        answers = self._ask(ids, self._dialect.state)
        states = self._states(answers.replies)
        if len(states) < len(set(ids)):
            raise _incomplete(answers, states)
        return states

    def write_goal(
        self, goals: Mapping[int, int], speeds_ticks_s: Mapping[int, float] | None = None
    ) -> None:
        """Send goal positions in one sync write. It is not acknowledged, so it can be lost."""
        speeds = speeds_ticks_s or {}
        values = {i: self._dialect.goal_bytes(t, speeds.get(i, 0.0)) for i, t in goals.items()}
        self._write(self._dialect.goal, values)

    def torque(self, ids: Sequence[int], on: bool) -> None:
        """Switch the drives of ``ids`` and read back that it happened.

        Before switching on, each goal is set to the present position, so that no servo jumps.
        Off is sent before any read, so that it also reaches a disturbed bus.

        Raises:
            ServoTimeout, ServoChecksum: some servos did not confirm.
            ServoFault: a servo with an alarm would not switch on.
        """
        if on:
            self.write_goal({i: s.position_ticks for i, s in self.read(ids).items()})
        self._write_checked(self._dialect.torque, {i: bytes((on,)) for i in ids}, harmless=not on)

    def driven(self, ids: Sequence[int]) -> dict[int, bool]:
        """Whether each servo's drive is on. It goes off after an alarm or a loss of power.

        Raises: ServoTimeout, ServoChecksum.
        """
        replies = self._fetch(ids, self._dialect.torque)
        return {servo_id: reply.data == b"\1" for servo_id, reply in replies.items()}

    def set_turns(self, many: Mapping[int, bool]) -> list[int]:
        """Allow servos more than one turn, or not. The servos store it permanently.

        Only servos set otherwise are written (their memory wears); their torque goes off. Returns
        the ids that were changed.
        """
        dialect = self._dialect
        wanted = {i: dialect.turns_bytes(flag) for i, flag in many.items()}
        found = self._fetch(list(many), dialect.turns)
        changed = {i: value for i, value in wanted.items() if found[i].data != value}
        if not changed:
            return []
        self.torque(list(changed), on=False)
        lock = dialect.turns_lock
        if lock is not None:
            self._write_checked(lock, dict.fromkeys(changed, b"\0"))
        try:
            self._write_checked(dialect.turns, changed)
        finally:
            if lock is not None:
                self._write_checked(lock, dict.fromkeys(changed, b"\1"))
        return sorted(changed)

    def close(self) -> None:
        """Release the port; torque stays as it is."""
        self._port.close()

    def _ask(self, ids: Sequence[int], block: Block, retries: int | None = None) -> Answers:
        return ask(
            self._port,
            self._dialect,
            lambda missing: self._dialect.sync_read(missing, block),
            ids,
            block.length,
            self._retries if retries is None else retries,
            self.counters,
        )

    def _fetch(self, ids: Sequence[int], block: Block) -> dict[int, Reply]:
        answers = self._ask(ids, block)
        self._refuse(answers.replies)
        if answers.silent or answers.corrupt:
            raise _incomplete(answers, {})
        return answers.replies

    def _refuse(self, replies: Mapping[int, Reply]) -> None:
        for servo_id, reply in replies.items():
            code = self._dialect.refusal(reply.error)
            if code:
                raise ServoRejected(servo_id, code)

    def _states(self, replies: Mapping[int, Reply]) -> dict[int, ServoState]:
        self._refuse(replies)
        alarms = self._alarms(replies)
        return {
            i: self._dialect.state_of(reply.data, alarms[i], self._models[i])
            for i, reply in replies.items()
            if i in alarms
        }

    def _alarms(self, replies: Mapping[int, Reply]) -> dict[int, ServoAlarm]:
        """Alarms by id. If the status byte only flags that there is one, the register is read."""
        known = {i: self._dialect.alarms(reply.error) for i, reply in replies.items()}
        unread = [i for i, flags in known.items() if flags is None]
        block = self._dialect.alarm
        if unread and block is not None:
            more = self._ask(unread, block).replies
            for i in unread:
                flags = self._dialect.alarm_flags(more[i].data[0]) if i in more else ServoAlarm.NONE
                known[i] = flags or ServoAlarm.OTHER
        return {i: flags for i, flags in known.items() if flags is not None}

    def _write(self, block: Block, values: Mapping[int, bytes]) -> None:
        self.counters.stale_bytes += self._port.send(self._dialect.sync_write(block, values))

    def _write_checked(
        self, block: Block, values: Mapping[int, bytes], harmless: bool = False
    ) -> None:
        """Write and read back; write again to servos that did not accept it."""
        wanted = dict(values)
        for _ in range(self._retries + 1):
            self._write(block, wanted)
            answers = self._ask(list(wanted), block, retries=0)
            taken = [i for i, reply in answers.replies.items() if reply.data == wanted[i]]
            for servo_id in taken:
                del wanted[servo_id]
            if not wanted:
                return
        if not harmless:
            self._raise_alarm(answers.replies)
        raise _incomplete(answers, {}, unconfirmed=wanted)

    def _raise_alarm(self, replies: Mapping[int, Reply]) -> None:
        for servo_id, flags in self._alarms(replies).items():
            if flags:
                raise ServoFault(servo_id, flags)


def _incomplete(
    answers: Answers, states: Mapping[int, ServoState], unconfirmed: Iterable[int] = ()
) -> IncompleteReply:
    silent = sorted({*answers.silent, *unconfirmed} - set(answers.corrupt))
    kind = ServoTimeout if silent else ServoChecksum
    return kind(silent, answers.corrupt, states, answers.attempts)
