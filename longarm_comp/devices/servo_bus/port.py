"""The serial port of a servo bus: sends and receives bytes; raises BusUnplugged if it fails."""

import contextlib
import errno
import grp
import os
import time

import serial
from serial.tools import list_ports

from longarm_comp.devices.servo_bus.state import BusUnplugged


class SerialPort:
    """A serial port, opened exclusively for this process.

    Args:
        reply_timeout_s: longest wait for an answer, s, beyond the time of its bytes on the wire.

    Raises:
        BusUnplugged: the port cannot be opened, another process holds it, or (from `send` and
            `receive`) it is gone.
    """

    def __init__(self, path: str, baudrate: int, reply_timeout_s: float = 0.02) -> None:
        self.path = path
        self.baudrate = baudrate
        self.reply_timeout_s = reply_timeout_s
        try:
            self._serial = serial.Serial(
                path, baudrate, timeout=reply_timeout_s, write_timeout=1.0, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise BusUnplugged(port=path, why=_in_words(path, error)) from error
        # Where a USB adapter has a latency timer (16 ms), that is most of a round trip.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            self._serial.set_low_latency_mode(True)

    def send(self, frame: bytes) -> int:
        """Discard stale input, then send a frame. Returns the number of bytes discarded."""
        try:
            stale = int(self._serial.in_waiting)
            if stale:
                self._serial.read(stale)
            self._serial.write(frame)
        except OSError as error:
            raise BusUnplugged(port=self.path, why=str(error)) from error
        return stale

    def receive(self, count: int) -> bytes:
        """Read ``count`` bytes; return fewer or none if the reply time-out passes first."""
        try:
            return bytes(self._serial.read(count))
        except OSError as error:
            raise BusUnplugged(port=self.path, why=str(error)) from error

    def deadline(self, byte_count: int) -> float:
        """Return the monotonic time, s, by which an answer of ``byte_count`` bytes is due."""
        return time.monotonic() + self.reply_timeout_s + 10.0 * byte_count / self.baudrate

    def close(self) -> None:
        """Release the port. Closing it twice, or after an unplug, raises nothing."""
        with contextlib.suppress(OSError):
            self._serial.close()


def _in_words(path: str, error: OSError | ValueError) -> str:
    """Return the reason why a port cannot be opened, and a remedy."""
    number = getattr(error, "errno", None)
    if number in (errno.EACCES, errno.EPERM):
        with contextlib.suppress(OSError, KeyError):
            group = grp.getgrgid(os.stat(path).st_gid).gr_name
            return (
                f"no permission: `sudo usermod -aG {group} $USER`, then log out and in again; "
                f"until then `sudo chmod a+rw {path}`"
            )
    if number in (errno.EBUSY, errno.EAGAIN):
        return "another program holds it: a running `longarm up`, or another terminal"
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        there = ", ".join(sorted(port.device for port in list_ports.comports()))
        return f"no such port; there are: {there or 'none'} (`longarm find-port` finds yours)"
    return str(error)
