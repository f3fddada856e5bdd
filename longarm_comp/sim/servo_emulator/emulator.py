"""A bus of emulated servos behind a pseudo-terminal; any client library may open it."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec
from longarm_comp.sim.servo_emulator.wire import Device, Wire
from longarm_comp.sim.servo_emulator.wires import wire_of


@dataclass
class WireFaults:
    """Replies to lose, damage or cut; counts go down as replies are sent."""

    silent: set[int] = field(default_factory=set)  # servos that hear and move but answer nothing
    drops: Counter[int] = field(default_factory=Counter)
    """drops, corrupt, cuts: how many of a servo's next replies are lost, have a damaged checksum,
    or end after their first half; by the servo's id."""
    corrupt: Counter[int] = field(default_factory=Counter)
    cuts: Counter[int] = field(default_factory=Counter)

    def apply(self, servo_id: int, reply: bytes) -> bytes:
        """Return the bytes that are sent for ``reply``."""
        if servo_id in self.silent or _take_one(self.drops, servo_id):
            return b""
        if _take_one(self.corrupt, servo_id):
            reply = reply[:-1] + bytes((reply[-1] ^ 0x5A,))
        if _take_one(self.cuts, servo_id):
            reply = reply[: len(reply) // 2]
        return reply


def _take_one(counts: Counter[int], servo_id: int) -> bool:
    if counts[servo_id] <= 0:
        return False
    counts[servo_id] -= 1
    return True


_STEP_S = 0.01  # in which a load is constant: a fraction of the 30 ms in which servos follow
Of = TypeVar("Of")


class ServoEmulator:
    """Servos on a pseudo-terminal, moved by a thread of their own.

    Args:
        protocol: name of one of `wires`, or a wire.
        positions: initial position of each servo, ticks, by id.
        spec: mechanics of all servos, or of each by id; none: an unloaded STS3215.
        link: path of a symbolic link to the pseudo-terminal, the same after every ``start``.
        loads: present external load of servos by id, as a signed share of the stall torque.
        clock: seconds, by which the servos move.

    Use as a context manager, or ``start`` and ``unplug``.
    """

    def __init__(
        self,
        protocol: str | Wire,
        positions: Mapping[int, float],
        spec: MotorSpec | Mapping[int, MotorSpec] | None = None,
        link: Path | None = None,
        loads: Callable[[], Mapping[int, float]] = dict,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._wire = wire_of(protocol, "servo emulator") if isinstance(protocol, str) else protocol
        same = MotorSpec() if spec is None else spec
        specs = dict.fromkeys(positions, same) if isinstance(same, MotorSpec) else same
        self._devices: dict[int, Device] = {
            i: self._wire.device(i, Motor(specs[i], ticks)) for i, ticks in positions.items()
        }
        self._link = link
        self._loads = loads
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._fds: tuple[int, int] | None = None
        self._clock, self._now = clock, clock()
        self.protocol = self._wire.name
        self.faults = WireFaults()
        self.port = ""
        self.frames_heard = 0

    def start(self) -> None:
        """Open a new pseudo-terminal (``port`` is its path) and begin to answer."""
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._fds = master, slave
        self.port = os.ttyname(slave)
        if self._link is not None:
            fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            fresh.symlink_to(self.port)
            fresh.replace(self._link)  # in one step, so that it is never missing
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve_bus, args=(master,), daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Pull the cable: the client's next read or write fails. Servos keep their power.

        It may be called twice. The link goes first, as a device file does: the next pseudo-terminal
        of any program may have the same number, and a client that tries again would take that one.
        """
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._fds is not None:
            for fd in self._fds:
                os.close(fd)
            self._fds = None

    def __enter__(self) -> ServoEmulator:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()

    @contextlib.contextmanager
    def motor(self, servo_id: int) -> Iterator[Motor]:
        """Yield the present mechanics of a servo, to read or to change."""
        with self._lock:
            self._advance_motors()
            yield self._devices[servo_id].motor

    def each(self, of: Callable[[Motor], Of]) -> dict[int, Of]:
        """Return what `of` returns for the present mechanics of every servo, by id."""
        with self._lock:
            self._advance_motors()
            return {i: of(device.motor) for i, device in self._devices.items()}

    def positions(self) -> dict[int, float]:
        """Return the present true positions, ticks by id, not rounded."""
        return self.each(lambda motor: motor.position)

    def torques_on(self) -> dict[int, bool]:
        return self.each(lambda motor: motor.torque_on)

    def power_cycle(self, servo_id: int) -> None:
        """Take a servo's power away and give it back."""
        with self._lock:
            self._advance_motors()
            self._wire.power_cycle(self._devices[servo_id])

    def push(self, servo_id: int, ticks: float) -> None:
        """Turn a servo by hand to ``ticks``; driven servos go back to their goal."""
        with self.motor(servo_id) as motor:
            motor.turn(ticks - motor.position)

    def _advance_motors(self) -> None:
        """Bring the mechanics up to the present in small steps (the load follows the motion)."""
        now = self._clock()
        while self._now < now:
            dt = min(_STEP_S, now - self._now)
            self._now += dt
            for servo_id, load in self._loads().items():
                self._devices[servo_id].motor.external_load = load
            for device in self._devices.values():
                device.motor.advance(dt)

    def _serve_bus(self, master: int) -> None:
        buffer = bytearray()
        while not self._stop.is_set():
            ready, _, _ = select.select([master], [], [], _STEP_S)
            if ready:
                buffer += os.read(master, 4096)
            with self._lock:
                self._advance_motors()
                frames = self._wire.take(buffer)
                self.frames_heard += len(frames)
                sent = [
                    self.faults.apply(servo_id, reply)
                    for frame in frames
                    for servo_id, reply in self._answer_frame(frame)
                ]
            for reply in sent:
                with contextlib.suppress(BlockingIOError):  # bytes that nobody reads are lost
                    os.write(master, reply)

    def _answer_frame(self, frame: bytes) -> list[tuple[int, bytes]]:
        try:
            replies = self._wire.answer(frame, self._devices)
        except IndexError:
            return []  # fewer parameters than the instruction needs: a servo ignores it
        if any(i != device.servo_id for i, device in self._devices.items()):
            self._devices = {device.servo_id: device for device in self._devices.values()}
        return replies
