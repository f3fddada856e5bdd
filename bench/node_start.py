"""Benchmarks of node start: from the start of the process to its first callback.

The reference is an rclpy node that offers only one service.  Discovery is not included: it belongs
to the middleware, and an existing client learns of any new node only with the next announcement,
up to 3 s later.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Sequence
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from bench.arms import demo_arm, demo_arm_file
from bench.comparison import Result, beside, missing
from bench.subprocess_cost import environment
from longarm_comp.core.errors import JobError

REPEATS = 5
FLOOR = "bare rclpy node"


def node(name: str) -> Result:
    """A node of the demonstration: `servo_driver` unconfigured, `kinematics` before it compiles."""
    if find_spec("rclpy") is None:
        return missing(FLOOR, "rclpy is not installed")
    found = ready_times()
    return beside("ms", found[name], FLOOR, found["bare"])


@lru_cache(maxsize=1)
def ready_times(repeats: int = REPEATS, *, warm: bool = True) -> dict[str, list[float]]:
    """Milliseconds of every node and of the reference, alternating; `warm`: one round first.

    Raises:
        JobError: a node did not start.
    """
    from longarm_comp.nodes.bringup import SIMULATED

    times: dict[str, list[float]] = {name: [] for name in ("bare", *SIMULATED)}
    with tempfile.TemporaryDirectory(prefix="longarm_bench_") as scratch:
        commands = _commands(Path(scratch), SIMULATED)
        if warm:  # read from disk once
            for command in commands.values():
                _ready(command, scratch)
        for _ in range(repeats):
            for name, command in commands.items():
                times[name].append(1e3 * _ready(command, scratch))
    return times


def _commands(folder: Path, nodes: Sequence[str]) -> dict[str, list[str]]:
    """Commands of the reference and of each node, which end when they serve."""
    from bench.dummy_predictor import train_dummy
    from longarm_comp.core.processes import run_module
    from longarm_comp.nodes.bringup import BringUp

    predictor = folder / "predictor.npz"
    train_dummy(demo_arm(), predictor)
    space = f"longarm_bench_{os.getpid()}"
    graph = BringUp(demo_arm_file(), predictor=predictor, sim=True, namespace=space)
    commands = {"bare": run_module("bench.bare_node")}
    started = graph.commands(folder)
    for node in nodes:
        module = f"longarm_comp.nodes.{node}"
        arguments = started[node][len(run_module(module)) :]
        commands[node] = [*run_module("bench.ready_node"), module, *arguments]
    return commands


def _ready(command: Sequence[str], folder: str) -> float:
    """Seconds until a process reports that it is ready."""
    variables = {
        **environment(),
        "ROS_LOG_DIR": folder,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    begin = time.perf_counter()
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=variables
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        said = process.stdout.readline()
        taken = time.perf_counter() - begin
        error = process.communicate(timeout=60)[1]
    if said.strip() != "ready":
        raise JobError(f"{' '.join(command[3:5])} did not come up: {error.strip()[-300:]}")
    return taken
