"""Starts processes, restarts those that die, and ends all of them in the end."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType

from longarm_comp.core.errors import JobError

GUARD = "LONGARM_SUPERVISOR"
"""Environment variable with the supervisor's process id. Its nodes end when it is gone."""
_GENTLE_S, _FIRM_S = 6.0, 2.0
"""Patience with SIGINT, s: a driver reads and switches off every servo; then with SIGTERM."""


@dataclass
class _Process:
    command: Sequence[str]
    process: subprocess.Popen[bytes]
    started: float
    deaths: int = 0


@dataclass
class Supervisor:
    """Processes by name. Use as a context manager."""

    commands: Mapping[str, Sequence[str]]  # program and arguments of each
    respawn: bool = True  # restart a process that ends, except after exit code 2 (bad input)
    say: Callable[[str], None] = lambda text: None  # called with a message on every start and end
    _children: dict[str, _Process] = field(default_factory=dict)

    def __enter__(self) -> Supervisor:
        try:
            for name, command in self.commands.items():
                self._children[name] = _Process(command, _start(command), time.monotonic())
                self.say(f"{name} started, pid {self._children[name].process.pid}")
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def pid(self, name: str) -> int:
        return self._children[name].process.pid

    def deaths(self, name: str) -> int:
        """How often a node has died and was restarted."""
        return self._children[name].deaths

    def look(self) -> None:
        for name, child in self._children.items():
            code = child.process.poll()
            if code is None:
                continue
            # 2: bad input
            if code == 2 or not self.respawn:
                raise JobError(f"{name} ended", exit_code=code)
            if time.monotonic() - child.started < 1.0:
                continue
            child.deaths += 1
            child.process, child.started = _start(child.command), time.monotonic()
            self.say(f"{name} ended ({_how(code)}), started again, pid {child.process.pid}")

    def run(self, stop: threading.Event) -> None:
        """Restart processes until the event is set. Raises as `look`."""
        while not stop.wait(0.2):
            self.look()

    def stop(self) -> None:
        """End all processes by SIGINT, then SIGTERM, then SIGKILL; returns when all are gone."""
        processes = [child.process for child in self._children.values()]
        for number, patience in ((signal.SIGINT, _GENTLE_S), (signal.SIGTERM, _FIRM_S)):
            _send(processes, number)
            deadline = time.monotonic() + patience
            for process in processes:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, deadline - time.monotonic()))
        _send(processes, signal.SIGKILL)
        for process in processes:
            process.wait()


def _start(command: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start in a session of its own, so that Ctrl-C reaches only the supervisor."""
    env = {**os.environ, GUARD: str(os.getpid())}
    return subprocess.Popen(command, env=env, start_new_session=True, stdin=subprocess.DEVNULL)


def _send(processes: Sequence[subprocess.Popen[bytes]], number: int) -> None:
    for process in processes:
        if process.poll() is None:
            process.send_signal(number)


def _how(code: int) -> str:
    return signal.Signals(-code).name if code < 0 else f"exit code {code}"
