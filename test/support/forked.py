"""Nodes in processes of their own, without the second that each takes to import its libraries.

A process beside each worker of pytest imports most of what nodes import, and forks. What it forks
runs a module as ``python -m`` does, with a parent that waits for its end and tells it, and ends it
where nobody hears that any more.
"""

import atexit
import faulthandler
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from functools import cache
from typing import IO

MOST_OF_IT = (
    *("longarm_comp.core.compensation." + n for n in ("compensate", "drift", "online", "weighing")),
    *("longarm_comp.core.compensation.planned_path", "longarm_comp.core.model.model_file"),
    *("longarm_comp.core.vibration.ring", "longarm_comp.core.learn.predictor_file"),
    *("longarm_comp.devices.servo_follower", "longarm_comp.devices.stop_latch"),
    *("control_msgs.msg", "geometry_msgs.msg", "sensor_msgs.msg", "trajectory_msgs.msg"),
    *("longarm_interfaces.action", "longarm_interfaces.msg", "longarm_interfaces.srv"),
)
"""What takes long; not rclpy, which starts threads."""
_FIELD = 16
"""Bytes of a number that the parent of a program tells: its process id, then how it ended."""
_MOST = 1 << 20
_SAFE = ["-P"] if sys.version_info >= (3, 11) else []


class ForkedProgram(subprocess.Popen[str]):
    """What was forked, as a started process; not a child of this process."""

    def __init__(self, words: Sequence[str], folder: str, env: dict[str, str], said: IO[str]):
        self.args, self.returncode = [sys.executable, *words], None  # type: ignore[assignment]
        self.stdin = self.stdout = self.stderr = None
        self._child_created = False  # for the destructor, which would wait for a child
        self._waitpid_lock = threading.Lock()
        self._told, tells = os.pipe()
        request = json.dumps({"words": list(words), "folder": folder, "env": env}).encode()
        socket.send_fds(_server(), [request], [said.fileno(), tells])
        os.close(tells)
        self.pid = self._number()

    def _number(self) -> int:
        text = os.read(self._told, _FIELD)
        if not text:
            raise RuntimeError("the process that forks nodes has ended")
        return int(text)

    def poll(self) -> int | None:
        """How it ended; None while it runs."""
        if self.returncode is None and select.select([self._told], [], [], 0)[0]:
            self.returncode = os.waitstatus_to_exitcode(self._number())
            os.close(self._told)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait until it ends; how."""
        if self.returncode is None and not select.select([self._told], [], [], timeout)[0]:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        code = self.poll()
        assert code is not None
        return code


@cache
def _server() -> socket.socket:
    """A connection with the process that forks."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for side in (here, there):
        side.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MOST)
    with there:
        process = subprocess.Popen(
            [sys.executable, *_SAFE, __file__, str(there.fileno())],
            pass_fds=(there.fileno(),),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )

    def end() -> None:
        here.close()
        process.wait()

    atexit.register(end)
    return here


def _fork(connection: socket.socket) -> list[str]:
    """Answer requests; in a forked process, return what it shall run."""
    while True:
        request, (said, tells), _, _ = socket.recv_fds(connection, _MOST, 2)
        if os.fork():
            os.close(said)
            os.close(tells)
            os.wait()
            continue
        if os.fork():
            os._exit(0)  # so that nobody waits for the parent of the program
        connection.close()
        if pid := os.fork():
            os.close(said)
            os.write(tells, str(pid).encode().ljust(_FIELD))
            _end_with_reader(pid, tells)
            os.write(tells, str(os.waitpid(pid, 0)[1]).encode().ljust(_FIELD))
            os._exit(0)
        os.close(tells)
        os.dup2(said, 1)
        os.dup2(said, 2)
        os.close(said)
        given = json.loads(request)
        os.chdir(given["folder"])
        os.environ.clear()
        os.environ.update(given["env"])
        return list(given["words"])


def _end_with_reader(pid: int, tells: int) -> None:
    """Wait until the program ends; kill it where the process that reads of it was killed.

    A driver that was left would answer the tests that get its domain next.
    """
    ended, watched = os.pidfd_open(pid), select.poll()
    watched.register(ended, select.POLLIN)
    watched.register(tells, 0)  # that nobody reads is always told
    if ended not in dict(watched.poll()):
        os.kill(pid, signal.SIGKILL)


def _serve(descriptor: int) -> None:
    for name in MOST_OF_IT:
        importlib.import_module(name)
    gc.freeze()
    assert len(os.listdir("/proc/self/task")) == 1, "a thread would be missing in what is forked"
    try:
        words = _fork(socket.socket(fileno=descriptor))
    except ValueError:  # no request any more
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    faulthandler.enable()
    module, *rest = words
    sys.modules.pop(module, None)  # it is run as the program, and none other
    sys.path.insert(0, os.getcwd())
    sys.argv = ["", *rest]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _serve(int(sys.argv[1]))
