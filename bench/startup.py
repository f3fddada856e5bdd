"""Benchmarks of start-up: commands and imports, each against its reference."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence

from bench.comparison import Result, beside

REPEATS = 7
NOTHING = ("-c", "pass")
NUMPY = ("-c", "import numpy")
NUMPY_PYDANTIC = ("-c", "import numpy, pydantic")


def _ended(arguments: Sequence[str]) -> float:
    """Wall seconds of a Python process from start to end."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
    return time.perf_counter() - begin


def _ends_beside(ours: Sequence[str], peer: str, theirs: Sequence[str], repeats: int) -> Result:
    _ended(ours), _ended(theirs)  # both read from disk once
    pairs = [(1e3 * _ended(ours), 1e3 * _ended(theirs)) for _ in range(repeats)]
    mine, other = zip(*pairs, strict=True)
    return beside("ms", mine, peer, other)


def help_page(repeats: int = REPEATS) -> Result:
    """``longarm --help`` beside a Python that does nothing."""
    ours = ("-m", "longarm_comp", "--help")
    return _ends_beside(ours, "python -c pass", NOTHING, repeats)


def import_core(repeats: int = REPEATS) -> Result:
    """Import of model and inverse kinematics, as in a control program, against numpy alone."""
    ours, peer = (
        ("-c", "import longarm_comp.core.compensation.compensate"),
        "python -c 'import numpy'",
    )
    return _ends_beside(ours, peer, NUMPY, repeats)


def import_arm(repeats: int = REPEATS) -> Result:
    """Import of the arm's declaration against the two libraries that it uses."""
    ours, peer = ("-c", "import longarm_comp.core.arm.arm"), "python -c 'import numpy, pydantic'"
    return _ends_beside(ours, peer, NUMPY_PYDANTIC, repeats)
