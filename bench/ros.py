"""Benchmarks of the graph's latency against a bare rclpy echo of the same messages.

Processes: `kinematics`, `error_predictor` with a trained predictor, the echo, and this one.
Blocks of calls alternate, so that all sides are measured under the same load.  The p50 of a target
is divided into shares.  DDS is the echo.  The predictor is its computation, as `kinematics` does
it too, times the questions of a target.  The inverse kinematics is the whole compensation, computed
here with a known error.  The node is the remainder (threads, executors, messages).
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.arms import demo_arm, demo_arm_file
from bench.comparison import Result, alone, beside
from bench.dummy_predictor import train_dummy
from longarm_comp.core.arm.arm import Arm

PEER = "bare rclpy echo of the same messages"
BLOCKS, PER_BLOCK = 8, 50
BURST = 80  # below every queue on the way
BURSTS = 3
FLOOD_HZ, FLOOD_S = 1000, 10
ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Figures:
    """The measured times and rates.

    Attributes:
        ms: (blocks, calls) of each call of `Calls`, by name.
        questions: learned errors that are looked up per target.
        rate, echo_rate: targets per second, one a burst.
    """

    ms: Mapping[str, np.ndarray]
    questions: float
    rate: np.ndarray
    echo_rate: np.ndarray

    @property
    def shares(self) -> dict[str, np.ndarray]:
        """Median milliseconds of a target, block by block; their sum is the whole."""
        dds, ik = _p(self.ms["topic_echo"], 50), _p(self.ms["compute"], 50)
        predictor = self.questions * _p(self.ms["predict"], 50)
        node = _p(self.ms["topic"], 50) - dds - ik - predictor
        return {"dds": dds, "predictor": predictor, "ik": ik, "node": node}


def beside_echo(path: str, percent: int) -> Result:
    """`target_pose` to `joint_trajectory` (topic), or the service `compensate`, not executed.

    Medians over the blocks for p50; p99 is that of all calls together.
    """
    f = figures()
    ours, echo = f.ms[path], f.ms[f"{path}_echo"]
    if percent != 50:
        ours, echo = ours.reshape(1, -1), echo.reshape(1, -1)
    mine, theirs = _p(ours, percent), _p(echo, percent)
    added = float(np.median(mine) - np.median(theirs))
    return beside("ms", mine, PEER, theirs, added_ms=added)


def answer_under_flood() -> Result:
    """Round trip of `compensate` beside a flood of targets."""
    from bench.ros_calls import Calls

    arm = demo_arm()
    with _graph(arm) as calls_on:
        calls: Calls = calls_on(Calls)
        calls.warm_up()
        words = ["-m", "bench.flood", str(FLOOD_HZ), str(FLOOD_S), "--ros-args"]
        space = f"__ns:={calls.namespace}"
        flood = subprocess.Popen(
            [sys.executable, *words, "-r", space], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        calls.await_flood()
        times: list[float] = []
        while flood.poll() is None:
            times.append(1e3 * calls.alone(len(times)))
        sent = int(flood.communicate()[0])
    p99 = float(np.percentile(times, 99))
    return alone(
        "ms", [p99], f"beside {FLOOD_HZ} targets a second",
        calls=len(times), p50=float(np.median(times)), targets=sent,
    )  # fmt: skip


def share(of: str) -> Result:
    """Share of a target: the echo (dds), the learned error (predictor), compensation with a known
    error (ik), the remainder (node)."""
    f, note = figures(), "of target_pose to joint_trajectory, p50"
    further = {"questions_per_target": f.questions} if of == "predictor" else {}
    return alone("ms", f.shares[of], note, **further)


def sustained_rate() -> Result:
    """Targets per second that are processed while others wait; above it queues grow."""
    f = figures()
    return beside("1/s", f.rate, PEER, f.echo_rate, more_is_better=True)


def _p(values: np.ndarray, share: float) -> np.ndarray:
    """Percentile of each block."""
    percentiles: np.ndarray = np.percentile(values, share, axis=1)
    return percentiles


@lru_cache(maxsize=1)
def figures(blocks: int = BLOCKS, per_block: int = PER_BLOCK) -> Figures:
    """All measurements, taken once per process."""
    from bench.ros_calls import Calls

    arm = demo_arm()
    with _graph(arm) as calls_on:
        calls: Calls = calls_on(Calls)
        calls.warm_up()
        sides = ("topic", "topic_echo", "service", "service_echo", "predict", "compute")
        ms: dict[str, list[list[float]]] = {side: [] for side in sides}
        for block in range(blocks):
            rows = range(block * per_block, (block + 1) * per_block)
            for side, times in ms.items():
                times.append([1e3 * getattr(calls, side)(i) for i in rows])
        per_target = calls.predictions_per_target(per_block)
        rates = [(calls.rate(BURST), calls.rate(BURST, echo=True)) for _ in range(BURSTS)]
    return Figures({k: np.array(v) for k, v in ms.items()}, per_target, *np.array(rates).T)


@contextmanager
def _graph(arm: Arm) -> Iterator[Callable[[Any], Any]]:
    """Run the processes; yields a function that creates the caller's side."""
    from longarm_comp.nodes.bringup import REAL, BringUp, Supervisor

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    space = f"longarm_bench_{os.getpid()}"
    with tempfile.TemporaryDirectory(prefix="longarm_bench_") as scratch:
        os.environ.setdefault("ROS_LOG_DIR", scratch)
        predictor = Path(scratch) / "predictor.npz"
        train_dummy(arm, predictor)
        graph = BringUp(
            arm=demo_arm_file(),
            predictor=predictor,
            namespace=space,
            without=tuple(n for n in REAL if n not in ("error_predictor", "kinematics")),
            set={"kinematics": {"acknowledged": False}},
        )
        echo = str(Path(__file__).with_name("ros_echo.py"))
        ros = ["--ros-args", "-r", f"__ns:=/{space}"]
        commands = {"echo": [sys.executable, echo, *ros], **graph.commands(Path(scratch))}
        with Supervisor(commands, respawn=False):
            nodes: list[Any] = []

            def calls_on(kind: Any) -> Any:
                nodes.append(kind(arm, space, predictor))
                return nodes[-1]

            try:
                yield calls_on
            finally:
                for calls in nodes:
                    calls.close()
