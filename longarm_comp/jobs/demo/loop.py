"""The loop, step by step: bring up, measure, collect, learn, reload, measure again."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from std_srvs.srv import Trigger

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import random_targets, sobol
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.identify.calibrate import declared_model
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.collect import collect
from longarm_comp.jobs.demo import table
from longarm_comp.jobs.demo.learn import Learned, learn
from longarm_comp.jobs.demo.setting import NAMESPACE, PACE, Setting, declared
from longarm_comp.jobs.demo.trial import Course, Trial
from longarm_comp.jobs.measurement_schedule import visits
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import running
from longarm_comp.nodes.simulated_arm import sizes
from longarm_comp.sessions.poses import write_poses
from longarm_comp.sim.plant import hidden_effects

Say = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Outcome:
    """Trials in order, what was learned, and how long each step took (s)."""

    trials: list[Trial]
    learned: Learned
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def improved(self) -> bool:
        """Whether compensation helped."""
        return table.improved(self.trials)


def demonstrate(
    setting: Setting, stop: threading.Event, say: Say = lambda text, share: None
) -> Outcome:
    """Run the whole loop; every process has ended when this returns or raises.

    Raises:
        InputError: the folder is not empty or cannot be written.
        JobError: a step could not be done. Interrupted: ``stop`` was set.
    """
    arm = declared(setting)
    hidden_effects(arm, sizes(setting.hidden), np.random.default_rng(setting.seed))  # or a refusal
    _prepare(setting)
    clock = _Clock()
    with ExitStack() as stack:
        supervisor = stack.enter_context(running(setting.graph()))
        ended = threading.Event()
        watch = threading.Thread(target=supervisor.run, args=(ended,), daemon=True)
        watch.start()
        stack.callback(watch.join, 5.0)
        stack.callback(ended.set)
        client = stack.enter_context(ArmClient(arm, NAMESPACE, stop, "demo"))
        say("bring up", 0.0)
        client.ready(60.0)
        course = Course(client, PACE)
        clock.done("bring_up")
        fresh = random_targets(declared_model(arm), setting.targets, setting.seed + 1)
        trials = [course.drive("original", fresh, "none", say)]
        clock.done("before")
        _collect(setting, arm, client, say)
        clock.done("collect")
        learned = learn(setting, arm, say)
        clock.done("learn")
        _reload(client)
        for name, method in (("deflection", "deflection"), ("deflection + network", "both")):
            trials.append(course.drive(name, fresh, method, say))
            clock.done(name)
    clock.done("clean_up")
    return Outcome(trials, learned, clock.seconds)


def _prepare(setting: Setting) -> None:
    if setting.out.exists() and (not setting.out.is_dir() or any(setting.out.iterdir())):
        raise InputError("demo", "--out", setting.out, "a new or empty folder")
    try:
        setting.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        said = error.strerror or str(error)
        raise InputError(setting.out, "--out", said, "a folder to write in") from error
    os.environ.setdefault("ROS_LOG_DIR", str(setting.out.absolute() / "log"))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def _collect(setting: Setting, arm: Arm, client: ArmClient, say: Say) -> None:
    plan = sobol(arm, setting.poses, setting.seed)
    write_poses(plan, setting.out / "poses.csv")
    todo = visits(plan, arm, repeats=min(5, setting.poses // 10), seed=setting.seed)
    collect(client, todo, setting.bag, pace=PACE, progress=say)


def _reload(client: ArmClient) -> None:
    """Both nodes take up what was learned."""
    for node in ("kinematics", "error_predictor"):
        service = graph.RELOAD.client(client.node, of=node)
        answer = client.call(service, Trigger.Request())
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


def report(setting: Setting, outcome: Outcome) -> dict[str, Any]:
    """Everything as plain data, for --json and the file in the folder."""
    kinds = {
        int(s): int((outcome.trials[-1].status == s).sum())
        for s in np.unique(outcome.trials[-1].status)
    }
    return {
        "rows": table.rows(outcome.trials),
        "improved": outcome.improved,
        "collected": len(outcome.learned.session),
        "status_of_last": kinds,
        "diagnosis": outcome.learned.finding,
        "effects_in_the_model": list(outcome.learned.effects),
        "network_inputs": list(outcome.learned.inputs),
        "hidden": setting.hidden,
        "seed": setting.seed,
        "seconds": {**outcome.seconds, "total": sum(outcome.seconds.values())},
        "files": {
            "session": str(setting.bag),
            "model": str(setting.model),
            "predictor": str(setting.predictor),
        },
    }
