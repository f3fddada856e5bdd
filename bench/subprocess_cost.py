"""Measures time and memory of a function in a process of its own.

The process prints one JSON object on its last line: the result, wall and processor seconds, and
the peak memory, in total and above the memory after the imports.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from longarm_comp.core.errors import JobError

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_ONE_THREAD = {f"{pool}_NUM_THREADS": "1" for pool in ("OMP", "OPENBLAS", "MKL")}


@dataclass(frozen=True)
class Cost:
    """Result, time and memory of a call.

    Attributes:
        result: the returned value, as JSON can hold it.
        cpu_s: processor seconds of the call without imports.
        grown_mb: peak memory above the memory before the call.
        peak_mb: peak memory in total.
    """

    result: Any
    cpu_s: float
    grown_mb: float
    peak_mb: float


def cost_of(module: str, function: str, *arguments: Any) -> Cost:
    """Call ``module.function(*arguments)`` in a new process with one BLAS thread.

    Raises:
        JobError: the process failed.
    """
    command = [sys.executable, "-m", "bench.subprocess_cost", module, function]
    done = subprocess.run(
        [*command, json.dumps(arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=environment() | _ONE_THREAD,
    )
    if done.returncode != 0:
        raise JobError(f"{function} ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    return Cost(**json.loads(done.stdout.splitlines()[-1]))


def environment() -> dict[str, str]:
    """This process's environment, in which another Python finds the same modules."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}


def _memory_mb(kind: str) -> float:
    """`VmRSS` (now) or `VmHWM` (at most) of this process."""
    if _STATUS.exists():
        for line in _STATUS.read_text().splitlines():
            if line.startswith(f"{kind}:"):
                return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # never falls


def main() -> None:
    """Entry point of the process that `cost_of` starts."""
    module, name, arguments = sys.argv[1:]
    function = getattr(importlib.import_module(module), name)
    with contextlib.suppress(OSError):
        _CLEAR.write_text("5")  # resets VmHWM
    before, used = _memory_mb("VmRSS"), time.process_time()
    result = function(*json.loads(arguments))
    cpu, peak = time.process_time() - used, _memory_mb("VmHWM")
    print(json.dumps(asdict(Cost(result, cpu, max(peak - before, 0.0), peak))))


if __name__ == "__main__":
    main()
