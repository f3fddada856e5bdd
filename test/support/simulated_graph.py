"""The graph of a simulated arm without predictor and stereo, and a client on it."""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nodes_bench import PATIENT, bench

from longarm_comp.core.arm.arm import Arm
from longarm_comp.jobs.client import ArmClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import BringUp


@contextmanager
def forked_graph(up: BringUp) -> Iterator[None]:
    """Run a graph's nodes as `bringup.running` does, but forked, and without a supervisor."""
    with tempfile.TemporaryDirectory(prefix="longarm_") as scratch, bench() as stage:
        fitting = up.with_servos(Path(scratch))
        for _, _, *words in fitting.commands(Path(scratch)).values():  # without `python -P`
            stage.python(words)
        yield


@contextmanager
def simulated_graph(
    arm: Path, kinematics: Mapping[str, Any], *, model: Path | None = None, speed: float = 10.0,
    tips: graph.Topic = graph.TIP_BY_READINGS, **nodes: Mapping[str, Any],
) -> Iterator[ArmClient]:  # fmt: skip
    """Run it with parameters of `kinematics` and of others; a busy machine may be late."""
    usual = {"method": "deflection", "compiled": False, **PATIENT}
    up = BringUp(
        arm=arm, model=model, sim=True, speed=speed,
        set={**nodes, "kinematics": {**usual, **kinematics}},
        without=("error_predictor", "stereo_bridge"),
    )  # fmt: skip
    with forked_graph(up), ArmClient(Arm.load(arm), tips=tips) as client:
        yield client
