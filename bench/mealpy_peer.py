"""mealpy as a benchmark peer, in a virtual environment of its own.

It pins numpy <= 1.26 and pulls a GPLv3 package (opfunu), so it never enters the package's own
environment.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.peer_environment import python_of
from longarm_comp.core.errors import JobError

REQUIREMENTS = ("mealpy==3.0.3", "numpy<=1.26")


class MealpyPeer:
    """A running mealpy process. It handles one request at a time."""

    def __init__(self, x: NDArray[Any], y: NDArray[Any], hidden: int) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._data = Path(self._folder.name) / "data.npz"
        self._hidden = hidden
        np.savez(self._data, x=x, y=y)
        worker = Path(__file__).with_name("mealpy_worker.py")
        self._process = subprocess.Popen(
            [str(python_of("mealpy", REQUIREMENTS)), str(worker)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> MealpyPeer:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()
        self._folder.cleanup()

    def solve(self, population: int, epochs: int, seed: int) -> dict[str, float]:
        """``evaluations``, ``seconds`` and ``fitness`` of one search.

        Raises
        ------
        JobError: the process ended without an answer.
        """
        request = {
            "data": str(self._data), "hidden": self._hidden, "population": population,
            "epochs": epochs, "seed": seed,
        }  # fmt: skip
        sender, receiver = self._process.stdin, self._process.stdout
        if sender is None or receiver is None:
            raise JobError("mealpy's process has no pipes")
        sender.write(json.dumps(request) + "\n")
        sender.flush()
        line = receiver.readline()
        if not line:
            raise JobError("mealpy ended without an answer", returncode=self._process.poll())
        answer: dict[str, float] = json.loads(line)
        return answer
