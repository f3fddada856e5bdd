"""One request to several servos, repeated for those without a usable answer."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from longarm_comp.devices.servo_bus.dialect import Dialect, Reply

if TYPE_CHECKING:
    from longarm_comp.devices.servo_bus.port import SerialPort


@dataclass(slots=True)
class BusCounters:
    """Counters of the bus since it was opened, for diagnostics."""

    requests: int = 0
    retries: int = 0
    timeouts: int = 0
    checksum_errors: int = 0
    stray_frames: int = 0
    stale_bytes: int = 0


@dataclass(slots=True)
class Answers:
    """Replies by id, and the ids that sent none or a damaged one."""

    replies: dict[int, Reply] = field(default_factory=dict)
    silent: tuple[int, ...] = ()
    corrupt: tuple[int, ...] = ()
    attempts: int = 0


def ask(
    port: SerialPort,
    dialect: Dialect,
    request: Callable[[Sequence[int]], bytes],
    ids: Sequence[int],
    data_length: int,
    retries: int,
    counters: BusCounters,
) -> Answers:
    """Send ``request(ids)`` and collect one intact reply of ``data_length`` bytes from each.

    The request is repeated up to ``retries`` times for servos with no answer or a damaged one.

    Raises:
        BusUnplugged: the port went away.
    """
    answers = Answers()
    missing = tuple(ids)
    while missing and answers.attempts <= retries:
        counters.requests += 1
        counters.retries += answers.attempts > 0
        answers.attempts += 1
        counters.stale_bytes += port.send(request(missing))
        damaged = _collect(port, dialect, missing, data_length, answers.replies, counters)
        missing = tuple(i for i in missing if i not in answers.replies)
        answers.corrupt = tuple(i for i in missing if i in damaged)
        answers.silent = tuple(i for i in missing if i not in damaged)
        counters.timeouts += len(answers.silent)
    return answers


def _collect(
    port: SerialPort,
    dialect: Dialect,
    ids: Sequence[int],
    data_length: int,
    replies: dict[int, Reply],
    counters: BusCounters,
) -> set[int]:
    """Read until every id has answered or time is up; returns ids with a damaged answer."""
    frame_length = dialect.overhead + data_length
    deadline = port.deadline(frame_length * len(ids))
    wanted = set(ids)
    damaged: set[int] = set()
    buffer = bytearray()
    final = False
    while wanted and not final:
        chunk = port.receive(max(1, frame_length * len(wanted) - len(buffer)))
        buffer += chunk
        final = not chunk or time.monotonic() > deadline
        for reply in dialect.decode(buffer, final):
            if not reply.intact:
                damaged.add(reply.servo_id)
                counters.checksum_errors += 1
            elif reply.servo_id in wanted and len(reply.data) == data_length:
                wanted.discard(reply.servo_id)
                replies[reply.servo_id] = reply
            elif reply.servo_id in wanted and reply.error:
                # An instruction refused: the servo answers without data.
                wanted.discard(reply.servo_id)
                replies[reply.servo_id] = reply
            else:
                counters.stray_frames += 1
    return damaged
