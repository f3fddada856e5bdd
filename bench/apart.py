"""Run a function in a process of its own: what it costs alone, in time and in memory.

The process answers one JSON object on its last line: the result, wall and processor seconds, and
the memory that it held at most, over what it held when its modules were imported.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from longarm_comp.core.errors import JobError

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_ONE_THREAD = {f"{pool}_NUM_THREADS": "1" for pool in ("OMP", "OPENBLAS", "MKL")}


@dataclass(frozen=True)
class Cost:
    """What a call returned and took.

    Attributes:
        result: whatever JSON can hold.
        wall_s, cpu_s: seconds of the call, imports not counted.
        grown_mb: memory held at most, beyond what was held before the call.
        peak_mb: memory held at most, all in all.
    """

    result: Any
    wall_s: float
    cpu_s: float
    grown_mb: float
    peak_mb: float


def cost_of(module: str, function: str, *arguments: Any) -> Cost:
    """Call ``module.function(*arguments)`` in a new process with one BLAS thread.

    Raises:
        JobError: it did not end well.
    """
    command = [sys.executable, "-m", "bench.apart", module, function]
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
    """The other side of `cost_of`."""
    module, name, arguments = sys.argv[1:]
    function = getattr(importlib.import_module(module), name)
    with contextlib.suppress(OSError):
        _CLEAR.write_text("5")  # VmHWM begins anew
    before, begin, used = _memory_mb("VmRSS"), time.perf_counter(), time.process_time()
    result = function(*json.loads(arguments))
    wall, cpu, peak = time.perf_counter() - begin, time.process_time() - used, _memory_mb("VmHWM")
    print(
        json.dumps(
            {
                "result": result,
                "wall_s": wall,
                "cpu_s": cpu,
                "grown_mb": max(peak - before, 0.0),
                "peak_mb": peak,
            }
        )
    )


if __name__ == "__main__":
    main()
