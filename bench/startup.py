"""Benchmarks of start-up: commands and imports, each against its reference."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence

from bench.comparison import Result, beside

REPEATS = 7
STARTS: dict[str, tuple[Sequence[str], str, Sequence[str]]] = {
    "help": (("-m", "longarm_comp", "--help"), "python -c pass", ("-c", "pass")),
    "core": (
        ("-c", "import longarm_comp.core.compensation.compensate"),
        "python -c 'import numpy'",
        ("-c", "import numpy"),
    ),
    "arm": (
        ("-c", "import longarm_comp.core.arm.arm"),
        "python -c 'import numpy, pydantic'",
        ("-c", "import numpy, pydantic"),
    ),
}
"""What is started, and its floor: the page of help beside a Python that does nothing; the import of
model and inverse kinematics, as in a control program; that of the arm's declaration."""


def beside_floor(name: str, repeats: int = REPEATS) -> Result:
    """Time a start of `STARTS` and its floor in turns, ms."""
    ours, peer, theirs = STARTS[name]
    _run_s(ours), _run_s(theirs)  # both read from disk once
    pairs = [(1e3 * _run_s(ours), 1e3 * _run_s(theirs)) for _ in range(repeats)]
    mine, other = zip(*pairs, strict=True)
    return beside("ms", mine, peer, other)


def _run_s(arguments: Sequence[str]) -> float:
    """Time a Python process from start to end, wall seconds."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
    return time.perf_counter() - begin
