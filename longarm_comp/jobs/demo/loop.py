"""The loop, step by step: bring up, measure, collect, diagnose, train, reload, measure again."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
from std_srvs.srv import Trigger

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.compensate import Method
from longarm_comp.core.data.plan import random_targets, sobol
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.identify.aliasing import EffectFinding
from longarm_comp.core.identify.calibrate import declared_model
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.collect import collect
from longarm_comp.jobs.demo import table
from longarm_comp.jobs.demo.learn import find_effects, train_network
from longarm_comp.jobs.demo.settings import NAMESPACE, PACE, DemoSettings
from longarm_comp.jobs.demo.witness import TrueTip
from longarm_comp.jobs.measurement_schedule import visits
from longarm_comp.jobs.targets import TargetRunner, Trial
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import running
from longarm_comp.nodes.simulated_arm import sizes
from longarm_comp.sessions.poses import write_poses
from longarm_comp.sim.plant import hidden_effects
from longarm_comp.workflows.diagnose import DiagnosisResult
from longarm_interfaces.srv import Compensate

Say = Callable[[str, float], None]

_READY_S = 120.0
"""Five processes start; on a busy machine that takes its time."""


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What came of it.

    Attributes:
        trials: in the order of `table`.
        collected: rows of the session.
        diagnosis: of it.
        inputs: of the network.
        seconds: how long each step took.
    """

    trials: list[Trial]
    collected: int
    diagnosis: DiagnosisResult
    inputs: tuple[str, ...]
    seconds: dict[str, float]

    @property
    def improved(self) -> bool:
        """Whether compensation helped."""
        return table.improved(self.trials)

    @property
    def outside(self) -> int:
        """How many targets of the last trial lay outside the network's training data."""
        return self.trials[-1].count(Compensate.Response.OUT_OF_DOMAIN)


def demonstrate(
    settings: DemoSettings, stop: threading.Event, say: Say = lambda text, share: None
) -> DemoResult:
    """Run the whole loop; every process has ended when this returns or raises.

    Raises:
        InputError: the folder is not empty or cannot be written.
        JobError: a step could not be done. Interrupted: ``stop`` was set.
    """
    arm = Arm.load(settings.arm)
    hidden_effects(arm, sizes(settings.hidden), np.random.default_rng(settings.seed))  # checked
    _prepare(settings)
    clock = _Clock()
    with ExitStack() as stack:
        supervisor = stack.enter_context(running(settings.graph()))
        ended = threading.Event()
        watch = threading.Thread(target=supervisor.run, args=(ended,), daemon=True)
        watch.start()
        stack.callback(watch.join, 5.0)
        stack.callback(ended.set)
        client = stack.enter_context(ArmClient(arm, NAMESPACE, stop, "demo"))
        say("bring up", 0.0)
        client.ready(_READY_S)
        runner = TargetRunner(client, PACE, TrueTip(client))
        fresh = random_targets(declared_model(arm), settings.targets, settings.seed + 1)
        runner.ready(fresh[0], _READY_S)
        clock.done("bring_up")
        trials = []

        def drive(name: str, method: Method) -> None:
            trials.append(runner.run(name, fresh, method, say))
            clock.done(name)

        drive(table.ORIGINAL, Method.NONE)
        drive(table.DECLARED, Method.DEFLECTION)
        collected = _collect(settings, arm, client, say)
        clock.done("collect")
        diagnosis = find_effects(settings, arm, say)
        clock.done("diagnose")
        predictor = train_network(settings, arm, say)
        clock.done("train")
        _reload(client)
        drive(table.FOUND, Method.DEFLECTION)
        drive(table.LEARNED, Method.BOTH)
    clock.done("clean_up")
    return DemoResult(trials, collected, diagnosis, tuple(predictor.encoding.names), clock.seconds)


def _prepare(settings: DemoSettings) -> None:
    if settings.out.exists() and (not settings.out.is_dir() or any(settings.out.iterdir())):
        raise InputError("demo", "--out", settings.out, "a new or empty folder")
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = error.strerror or str(error)
        raise InputError(settings.out, "--out", why, "a folder to write in") from error
    os.environ.setdefault("ROS_LOG_DIR", str(settings.out.absolute() / "log"))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def _collect(settings: DemoSettings, arm: Arm, client: ArmClient, say: Say) -> int:
    plan = sobol(arm, settings.poses, settings.seed)
    write_poses(plan, settings.out / "poses.csv")
    todo = visits(plan, arm, repeats=min(5, settings.poses // 10), seed=settings.seed)
    return collect(client, todo, settings.bag, pace=PACE, progress=say).made


def _reload(client: ArmClient) -> None:
    """Both nodes take up what was learned."""
    for node in ("kinematics", "error_predictor"):
        service = graph.RELOAD.client(client.node, of=node)
        answer = client.call(service, Trigger.Request(), again=True)
        if not answer.success:
            raise JobError(f"{node} did not take up its file: {answer.message}")


class _Clock:
    """Seconds of each step."""

    def __init__(self) -> None:
        self._begun = time.monotonic()
        self.seconds: dict[str, float] = {}

    def done(self, step: str) -> None:
        now = time.monotonic()
        self.seconds[step], self._begun = now - self._begun, now


def _names(finding: EffectFinding) -> list[str]:
    """An effect, what cannot be told from it, and what could stand for a part of it."""
    return list(dict.fromkeys((*finding.names, *(a.name for a in finding.partial_aliases))))


def report(settings: DemoSettings, result: DemoResult) -> dict[str, Any]:
    """Everything as plain data, for --json and the file in the folder."""
    files = {
        "session": settings.bag,
        "model": settings.model,
        "predictor": settings.predictor,
        "report": settings.out / "report.html",
    }
    return {
        "rows": table.rows(result.trials),
        "improved": result.improved,
        "collected": result.collected,
        "outside_training_data": result.outside,
        "verdict": result.diagnosis.verdict,
        "diagnosis": result.diagnosis.summary,
        "effects_found": [_names(finding) for finding in result.diagnosis.findings],
        "network_inputs": list(result.inputs),
        "hidden": settings.hidden,
        "seed": settings.seed,
        "seconds": {**result.seconds, "total": sum(result.seconds.values())},
        "files": {name: str(path) for name, path in files.items()},
    }
