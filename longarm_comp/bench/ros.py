"""Latency of the graph beside a bare rclpy echo of the same messages, in the same run.

Processes: `kinematics`, `error_predictor` with a trained predictor, the echo, and this one.
Blocks of calls take turns, so that every side meets the machine in the same mood.  Shares: DDS
is the echo; the predictor is its service's round trip times the calls that a target takes; the
rest is inverse kinematics and the node around it.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.bench.kinematics import demo_arm
from longarm_comp.core.arm import Arm
from longarm_comp.jobs.stand_in import train_stand_in

PEER = "bare rclpy echo of the same messages"
BLOCKS, PER_BLOCK = 8, 50
BURST = 80  # below every queue on the way


@dataclass(frozen=True)
class Figures:
    """Milliseconds (blocks, calls) of each path, and what else was measured."""

    topic: np.ndarray
    topic_echo: np.ndarray
    service: np.ndarray
    service_echo: np.ndarray
    predictor: np.ndarray
    calls_per_target: float
    rate_hz: float
    echo_rate_hz: float


def ros_target_to_trajectory_vs_echo_p50_ms() -> dict[str, object]:
    """`target_pose` to `joint_trajectory`."""
    f = figures()
    row = _row("ros_target_to_trajectory_vs_echo_p50_ms", f.topic, f.topic_echo)
    dds, predictor = _p(f.topic_echo, 50), f.calls_per_target * _p(f.predictor, 50)
    return {
        **row,
        "share_ms": {
            "dds": dds,
            "predictor": predictor,
            "ik_and_node": _p(f.topic, 50) - dds - predictor,
        },
        "predictor_calls": f.calls_per_target,
        "sustained_rate_hz": f.rate_hz,
        "echo_rate_hz": f.echo_rate_hz,
    }


def ros_compensate_vs_echo_p50_ms() -> dict[str, object]:
    """Round trip of the `compensate` service, not executed."""
    f = figures()
    return _row("ros_compensate_vs_echo_p50_ms", f.service, f.service_echo)


def _p(values: np.ndarray, share: float) -> float:
    return float(np.percentile(values, share))


def _row(name: str, ours: np.ndarray, echo: np.ndarray) -> dict[str, object]:
    each = np.median(echo, axis=1) / np.median(ours, axis=1)
    return {
        "name": name,
        "value": _p(ours, 50),
        "unit": "ms",
        "peer": PEER,
        "peer_value": _p(echo, 50),
        "ratio": float(np.median(each)),
        "spread": [float(each.min()), float(each.max())],
        "p99_ms": _p(ours, 99),
        "peer_p99_ms": _p(echo, 99),
        "added_p50_ms": _p(ours, 50) - _p(echo, 50),
        "added_p99_ms": _p(ours, 99) - _p(echo, 99),
    }


@lru_cache(maxsize=1)
def figures(blocks: int = BLOCKS, per_block: int = PER_BLOCK) -> Figures:
    """Everything, measured once a process."""
    from longarm_comp.bench.ros_calls import Calls

    arm = demo_arm()
    with _graph(arm) as calls_on:
        calls: Calls = calls_on(Calls)
        calls.warm_up()
        sides: tuple[Callable[[int], float], ...] = (
            calls.topic, calls.topic_echo, calls.service, calls.service_echo, calls.predict,
        )  # fmt: skip
        made: list[list[list[float]]] = [[] for _ in sides]
        for block in range(blocks):
            rows = range(block * per_block, (block + 1) * per_block)
            for side, call in zip(made, sides, strict=True):
                side.append([1e3 * call(i) for i in rows])
        per_target = calls.predictions_per_target(per_block)
        rate, echo_rate = calls.rate(BURST), calls.echo_rate(BURST)
    topic, topic_echo, service, service_echo, predictor = (np.array(side) for side in made)
    return Figures(topic, topic_echo, service, service_echo, predictor, per_target, rate, echo_rate)


@contextmanager
def _graph(arm: Arm) -> Iterator[Callable[[Any], Any]]:
    """The processes; gives what makes the caller's side."""
    from longarm_comp.nodes.bringup import folder
    from longarm_comp.nodes.supervisor import Supervisor

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    space = f"longarm_bench_{os.getpid()}"
    arm_file = folder("config") / "arm_demo.yaml"
    with tempfile.TemporaryDirectory(prefix="longarm_bench_") as scratch:
        os.environ.setdefault("ROS_LOG_DIR", scratch)
        predictor = Path(scratch) / "predictor.npz"
        train_stand_in(arm, predictor)
        module, ros = [sys.executable, "-m"], ["--ros-args", "-r", f"__ns:=/{space}"]
        file = ["-p", f"arm:='{arm_file}'"]
        commands = {
            "echo": [*module, "longarm_comp.bench.ros_echo", *ros],
            "kinematics": [*module, "longarm_comp.nodes.kinematics", *ros, *file],
            "error_predictor": [
                *(*module, "longarm_comp.nodes.error_predictor", *ros, *file),
                *("-p", f"predictor:='{predictor}'"),
            ],
        }
        with Supervisor(commands, respawn=False):
            made: list[Any] = []

            def calls_on(kind: Any) -> Any:
                made.append(kind(arm, space))
                return made[-1]

            try:
                yield calls_on
            finally:
                for calls in made:
                    calls.close()
