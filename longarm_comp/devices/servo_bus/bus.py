"""A bus of servos: reads states, sends goals, switches torque. Each failure has its error class."""

import operator
import time
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from longarm_comp.devices.servo_bus.dialect import Block, Dialect, Reply
from longarm_comp.devices.servo_bus.memory import ServoMemory
from longarm_comp.devices.servo_bus.port import SerialPort
from longarm_comp.devices.servo_bus.state import (
    IncompleteReply,
    ServoAlarm,
    ServoFault,
    ServoModel,
    ServoState,
)

GOAL_TICKS = 8
"""Largest difference, ticks, of a read-back goal that counts as accepted: 0.7 degrees."""

AGREE_TICKS = 40
"""Largest difference of two readings in succession that are believed: 3.5 degrees of a servo.

A hand that moves a free arm turns no servo so far between two readings (some ms), and a damaged
byte that changes a position by less causes as small a jump only.
"""

Change = tuple[bytes, bytes]
"""A change of a servo's memory: the bytes stored before, and the new bytes."""


@dataclass(slots=True)
class _BusCounters:
    """Counters of the bus since it was opened, for diagnostics."""

    requests: int = 0
    retries: int = 0
    timeouts: int = 0
    checksum_errors: int = 0
    stray_frames: int = 0
    stale_bytes: int = 0


@dataclass(slots=True)
class Answers:
    """Replies by servo id, the ids without a reply or with a damaged one, and the attempts."""

    replies: dict[int, Reply] = field(default_factory=dict)
    silent: tuple[int, ...] = ()
    corrupt: tuple[int, ...] = ()
    attempts: int = 0


class SerialServoBus:
    """Servos of one protocol on one serial port.

    Args:
        models: model of each servo, by id. The method `read` is only for these ids.
        retries: how often a servo without a usable answer is asked again.

    Every method raises :class:`BusUnplugged` when the port goes away. Not thread-safe.
    """

    def __init__(
        self, port: SerialPort, dialect: Dialect, models: Mapping[int, ServoModel], retries: int = 2
    ) -> None:
        self._port = port
        self._dialect = dialect
        self._models = dict(models)
        self._retries = retries
        self.port, self.protocol, self.counters = port.path, dialect.name, _BusCounters()

    def ping(self, servo_id: int) -> int:
        """Read the servo's model number. Raises IncompleteReply."""
        number = self._fetch_block([servo_id], self._dialect.model)[servo_id]
        return int.from_bytes(number, "little")

    def model_name(self, number: int) -> str:
        """Return the name of the model with this number; empty if unknown."""
        return self._dialect.model_name(number)

    def memory(self, ids: Sequence[int]) -> dict[int, ServoMemory]:
        """Read the registers that each servo keeps without power. Raises IncompleteReply."""
        read = self._fetch_block(ids, self._dialect.memory)
        return {i: self._dialect.memory_of(data) for i, data in read.items()}

    def alarms(self, ids: Sequence[int]) -> dict[int, str]:
        """Read the present alarms, in words, with supply voltage and temperature.

        Servos without an alarm, and those that do not answer, are left out.
        """
        replies = self.ask(ids, self._dialect.state).replies
        said = {}
        for servo_id, flags in self._read_alarms(replies).items():
            if len(replies[servo_id].data) != self._dialect.state.length:
                continue
            # Neither supply nor temperature depends on the model
            state = self._dialect.state_of(replies[servo_id].data, flags, self._dialect.models[0])
            if state.error_flags:
                said[servo_id] = (
                    f"{state.error_flags.words} (at {state.voltage_v:.1f} V, "
                    f"{state.temperature_c:.0f} C)"
                )
        return said

    def read(self, ids: Sequence[int]) -> dict[int, ServoState]:
        """Read the state of the servos by sync read, with retries.

        Raises:
            IncompleteReply: not all servos answered; its ``states`` has those that did.
            ServoFault: a servo refused the read.
        """
        answers = self.ask(ids, self._dialect.state)
        self._check_refusals(answers.replies)
        alarms = self._read_alarms(answers.replies)
        states = {
            i: self._dialect.state_of(reply.data, alarms[i], self._models[i])
            for i, reply in answers.replies.items()
            if i in alarms
        }
        if len(states) < len(set(ids)):
            raise _make_incomplete(answers, states)
        return states

    def write_goal(
        self, goals: Mapping[int, int], speeds_ticks_s: Mapping[int, float] | None = None
    ) -> None:
        """Send goal positions, ticks by id, in one sync write.

        Servos do not acknowledge it, so it can be lost (`hold` reads the goals back).

        Args:
            speeds_ticks_s: speeds by id; without one, or for 0, a servo moves as fast as it can.
        """
        speeds = speeds_ticks_s or {}
        values = {i: self._dialect.goal_bytes(t, speeds.get(i, 0.0)) for i, t in goals.items()}
        self._send_frame(self._dialect.sync_write(self._dialect.goal, values))

    def hold(self, goals: Mapping[int, int]) -> set[int]:
        """Send goal positions, ticks by id; return the ids whose read-back goal is another one."""
        values = {i: self._dialect.goal_position_bytes(ticks) for i, ticks in goals.items()}
        wanted, _ = self._write_until(self._dialect.goal_position, values, self._is_near)
        return set(wanted)

    def _is_near(self, read: bytes, sent: bytes) -> bool:
        ticks_of = self._dialect.ticks_of
        return len(read) == len(sent) and abs(ticks_of(read) - ticks_of(sent)) <= GOAL_TICKS

    def goals(self, ids: Sequence[int]) -> dict[int, int]:
        """Read the goal positions, ticks. Raises IncompleteReply."""
        read = self._fetch_block(ids, self._dialect.goal_position)
        return {i: self._dialect.ticks_of(data) for i, data in read.items()}

    def torque(self, ids: Sequence[int], on: bool, kept: Container[int] = ()) -> None:
        """Switch the drives of ``ids`` on or off, and confirm it by reading back.

        Before switching on, each goal is set to the present position and read back, so that no
        servo jumps. A servo beyond its own limits accepts no such goal, so it is refused. Off is
        sent before anything is read, so that it also reaches a disturbed bus.

        Args:
            kept: ids of driven servos that keep their present goal.

        Raises:
            IncompleteReply: some servos did not confirm, or their readings do not agree.
            ServoFault: a servo with an alarm does not switch on, or a servo would jump.
        """
        if on:
            goals = self._read_agreed(ids)
            for servo_id, memory in self.memory(ids).items():
                if why := memory.describe_jump(goals[servo_id]):
                    raise ServoFault(f"servo {servo_id} {why}")
            values = {
                i: self._dialect.goal_position_bytes(goal)
                for i, goal in goals.items()
                if i not in kept
            }
            self._write_checked(self._dialect.goal_position, values, taken=self._is_near)
        self._write_checked(self._dialect.torque, {i: bytes((on,)) for i in ids}, harmless=not on)

    def _read_agreed(self, ids: Sequence[int]) -> dict[int, int]:
        """Read positions, ticks by id, until two successive readings of each servo agree.

        A damaged reply may pass its checksum, and the servo would move to a wrong goal.
        """
        before, agreed = self.read(ids), dict[int, int]()
        for _ in range(self._retries + 2):
            now = self.read(ids)
            for i, state in now.items():
                if abs(state.position_ticks - before[i].position_ticks) <= AGREE_TICKS:
                    agreed[i] = state.position_ticks
            if len(agreed) == len(now):
                return agreed
            before = now
        left = sorted(before.keys() - agreed.keys())
        raise IncompleteReply("readings of servos do not agree: hold the arm still", ids=left)

    def driven(self, ids: Sequence[int]) -> dict[int, bool]:
        """Read whether each servo's drive is on. It goes off after an alarm or a loss of power.

        Raises: IncompleteReply.
        """
        read = self._fetch_block(ids, self._dialect.torque)
        return {i: data == b"\1" for i, data in read.items()}

    def turns(self, ids: Sequence[int]) -> dict[int, bytes]:
        """Read the stored bytes that decide between one turn and many. Raises IncompleteReply."""
        return self._fetch_block(ids, self._dialect.turns)

    def set_turns(
        self,
        many: Mapping[int, bool],
        before: Callable[[dict[int, Change]], None] = lambda changes: None,
    ) -> list[str]:
        """Set servos permanently for many turns, or for one.

        Only servos that are set differently are written, because their memory wears. Their torque
        is switched off.

        Args:
            many: by servo id, whether it may turn more than once.
            before: called with the changes, by servo id, before they are made; it may raise.

        Returns:
            One sentence about each changed servo.
        """
        dialect = self._dialect
        changes = {
            i: (stored, dialect.turns_bytes(many[i]))
            for i, stored in self.turns(list(many)).items()
            if dialect.turns_of(stored) != many[i]
        }
        if changes:
            before(changes)
            self.store_turns({i: wanted for i, (_, wanted) in changes.items()})
        return [
            f"servo {i} is set for {'many turns' if many[i] else 'one turn'}, as the servo file "
            f"says: {dialect.turns_said(new)} instead of {dialect.turns_said(had)}"
            for i, (had, new) in changes.items()
        ]

    def store_turns(self, stored: Mapping[int, bytes]) -> None:
        """Switch the torque off and write the bytes that decide about turns, by servo id.

        If a lock protects them, it is opened before and restored afterwards.
        """
        self.torque(list(stored), on=False)
        lock = self._dialect.turns_lock
        if lock is None:
            self._write_checked(self._dialect.turns, stored)
            return
        before = self._fetch_block(list(stored), lock)
        self._write_checked(lock, dict.fromkeys(stored, b"\0"))
        try:
            self._write_checked(self._dialect.turns, stored)
        finally:
            self._write_checked(lock, before)

    def close(self) -> None:
        """Release the port; torque stays as it is."""
        self._port.close()

    def ask(self, ids: Sequence[int], block: Block, retries: int | None = None) -> Answers:
        """Read a block from all ids; ask again, up to ``retries`` times, without a good answer."""
        answers = Answers()
        missing = tuple(ids)
        while missing and answers.attempts <= (self._retries if retries is None else retries):
            self.counters.requests += 1
            self.counters.retries += answers.attempts > 0
            answers.attempts += 1
            self._send_frame(self._dialect.sync_read(missing, block))
            damaged = self._collect_replies(missing, block.length, answers.replies)
            missing = tuple(i for i in missing if i not in answers.replies)
            answers.corrupt = tuple(i for i in missing if i in damaged)
            answers.silent = tuple(i for i in missing if i not in damaged)
            self.counters.timeouts += len(answers.silent)
        return answers

    def _collect_replies(
        self, ids: Sequence[int], data_length: int, replies: dict[int, Reply]
    ) -> set[int]:
        """Add good replies to ``replies`` until the time is over; return ids with a damaged one."""
        frame_length = self._dialect.overhead + data_length
        deadline = self._port.deadline(frame_length * len(ids))
        wanted = set(ids)
        damaged: set[int] = set()
        buffer, final = bytearray(), False
        while wanted and not final:
            chunk = self._port.receive(max(1, frame_length * len(wanted) - len(buffer)))
            buffer += chunk
            final = not chunk or time.monotonic() > deadline
            for reply in self._dialect.decode(buffer, final):
                if not reply.intact:
                    damaged.add(reply.servo_id)
                    self.counters.checksum_errors += 1
                elif reply.servo_id in wanted and (
                    len(reply.data) == data_length or self._dialect.refusal(reply.error)
                ):
                    wanted.discard(reply.servo_id)
                    replies[reply.servo_id] = reply
                else:
                    self.counters.stray_frames += 1
        return damaged

    def _send_frame(self, frame: bytes) -> None:
        self.counters.stale_bytes += self._port.send(frame)

    def _fetch_block(self, ids: Sequence[int], block: Block) -> dict[int, bytes]:
        answers = self.ask(ids, block)
        self._check_refusals(answers.replies)
        if answers.silent or answers.corrupt:
            raise _make_incomplete(answers)
        return {i: reply.data for i, reply in answers.replies.items()}

    def _check_refusals(self, replies: Mapping[int, Reply]) -> None:
        for servo_id, reply in replies.items():
            if code := self._dialect.refusal(reply.error):
                raise ServoFault("the servo refused the instruction", id=servo_id, code=code)

    def _read_alarms(self, replies: Mapping[int, Reply]) -> dict[int, ServoAlarm]:
        """Return alarms by id; if the status byte only flags an alarm, read its register."""
        known = {i: self._dialect.alarms(reply.error) for i, reply in replies.items()}
        unread = [i for i, flags in known.items() if flags is None]
        block = self._dialect.alarm
        if unread and block is not None:
            more = self.ask(unread, block).replies
            for i in unread:
                bits = int.from_bytes(more[i].data, "little") if i in more else 0
                known[i] = self._dialect.alarm_flags(bits) or ServoAlarm.OTHER
        return {i: flags for i, flags in known.items() if flags is not None}

    def _write_checked(
        self,
        block: Block,
        values: Mapping[int, bytes],
        harmless: bool = False,
        taken: Callable[[bytes, bytes], bool] = operator.eq,
    ) -> None:
        """Write values by id; raise an error if a servo does not accept or confirm its value.

        Args:
            harmless: whether alarms are not looked for as the cause.
            taken: called with the bytes read and the bytes sent; tells whether they were accepted.
        """
        wanted, answers = self._write_until(block, values, taken)
        if not wanted:
            return
        if not harmless:
            for servo_id, flags in self._read_alarms(answers.replies).items():
                if flags:
                    raise ServoFault("the servo reports an alarm", id=servo_id, alarm=flags.words)
        raise _make_incomplete(answers, unconfirmed=wanted)

    def _write_until(
        self, block: Block, values: Mapping[int, bytes], taken: Callable[[bytes, bytes], bool]
    ) -> tuple[dict[int, bytes], Answers]:
        """Write values with repetitions; return those not accepted, by id, and the last answers."""
        wanted, answers, tries = dict(values), Answers(), self._retries + 1
        while wanted and tries:
            tries -= 1
            self._send_frame(self._dialect.sync_write(block, wanted))
            answers = self.ask(list(wanted), block, retries=0)
            for servo_id, reply in answers.replies.items():
                if taken(reply.data, wanted[servo_id]):
                    del wanted[servo_id]
        return wanted, answers


def _make_incomplete(
    answers: Answers,
    states: Mapping[int, ServoState] | None = None,
    unconfirmed: Iterable[int] = (),
) -> IncompleteReply:
    silent = sorted({*answers.silent, *unconfirmed} - set(answers.corrupt))
    return IncompleteReply(
        "servos did not answer in time" if silent else "answers of servos failed their checksum",
        states,
        silent=silent,
        corrupt=list(answers.corrupt),
        answered=sorted(states or ()),
        attempts=answers.attempts,
    )
