"""`longarm servo setup` on a terminal, and the flags that tell it the truth."""

import contextlib
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable

RIGHT = ("--direction", "joint1=-", "--direction", "joint2=+", "--direction", "joint3=-",
         "--yes", "--ids", "1-3")  # fmt: skip


class Terminal:
    """``longarm`` in a process of its own, on a terminal."""

    def __init__(self, *words: object) -> None:
        self._master, slave = pty.openpty()
        self._text = ""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "longarm_comp", *map(str, words)],
            stdin=slave, stdout=slave, stderr=slave, start_new_session=True,
            env={**os.environ, "COLUMNS": "200", "TERM": "xterm"},
        )  # fmt: skip
        os.close(slave)

    def until(self, *words: str) -> str:
        """Read until one of the words was said since the last one, and return it."""
        while not (found := [word for word in words if word in self._text]):
            assert select.select([self._master], [], [], 60.0)[0], self._text
            try:
                self._text += os.read(self._master, 4096).decode(errors="replace")
            except OSError:  # it has ended
                raise AssertionError(self._text) from None
        self._text = self._text.split(found[0], 1)[1]
        return found[0]

    def say(self, text: str) -> None:
        os.write(self._master, f"{text}\n".encode())

    def read_while(self, lasting: Callable[[], bool]) -> None:
        while lasting():
            if select.select([self._master], [], [], 0.05)[0]:
                with contextlib.suppress(OSError):
                    self._text += os.read(self._master, 4096).decode(errors="replace")

    def kill(self) -> None:
        """SIGKILL: nothing is put right."""
        self.process.kill()
        self.process.wait()
        os.close(self._master)

    def stop(self) -> int:
        """SIGTERM until it ends: one that comes just before a read of the terminal waits for it."""
        ends = time.monotonic() + 300.0
        while self.process.poll() is None and time.monotonic() < ends:
            self.process.send_signal(signal.SIGTERM)
            again = time.monotonic() + 5.0
            self.read_while(lambda by=again: self.process.poll() is None and time.monotonic() < by)
        return self.end()

    def end(self) -> int:
        ends = time.monotonic() + 300.0
        self.read_while(lambda: self.process.poll() is None and time.monotonic() < ends)
        assert self.process.poll() is not None, self._text
        os.close(self._master)
        return self.process.returncode
