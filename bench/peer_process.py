"""Peers whose requirements conflict with ours, each in a virtual environment of its own.

mealpy pins numpy <= 1.26 and pulls a GPLv3 package (opfunu), so it never enters the package's own
environment.  Environments are created on demand in the user's cache folder and kept between runs.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import venv
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.errors import JobError

REQUIREMENTS = {"mealpy": ("mealpy==3.0.3", "numpy<=1.26"), "pybotics": ("pybotics==3.1.2",)}


class PeerProcess:
    """A worker of this folder, ``NAME_worker.py``, running in the environment of a peer.

    Args:
        name: of the peer, one of `REQUIREMENTS`.
        arrays: what the worker finds in the file that every request names as ``data``.

    Raises:
        JobError: the peer cannot be installed (no network, or no version for this Python).
    """

    def __init__(self, name: str, **arrays: Any) -> None:
        self._name, self._folder = name, tempfile.TemporaryDirectory()
        self._data = Path(self._folder.name) / "data.npz"
        np.savez(self._data, **arrays)
        worker = Path(__file__).with_name(f"{name}_worker.py")
        command = [str(_make_environment(name)), str(worker)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)

    def __enter__(self) -> PeerProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()
        self._folder.cleanup()

    def ask(self, **request: Any) -> dict[str, float]:
        """Send one request and return its answer.

        Raises:
            JobError: the process ended without an answer; it said why on stderr.
        """
        sender, receiver = self._process.stdin, self._process.stdout
        assert sender is not None and receiver is not None
        with suppress(BrokenPipeError):
            sender.write(json.dumps({"data": str(self._data), **request}) + "\n")
            sender.flush()
        line = receiver.readline()
        if not line:
            code = self._process.wait()
            raise JobError(f"{self._name} ended without an answer", returncode=code)
        answer: dict[str, float] = json.loads(line)
        return answer


def _make_environment(name: str) -> Path:
    """Return the Python of a peer's environment, which is created on the first call."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "longarm_comp" / f"{name}-py{sys.version_info[0]}{sys.version_info[1]}"
    python = folder / "bin" / "python"
    ready = folder / "ready"
    if not ready.exists():
        venv.create(folder, with_pip=True, clear=True)
        command = [str(python), "-m", "pip", "install", "--quiet", *REQUIREMENTS[name]]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise JobError(f"{name} cannot be installed: {done.stderr.strip()[-300:]}")
        ready.touch()
    return python
