"""Runs the soak test: targets at a steady rate, faults at random times, a report at the end."""

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np

from bench.dummy_predictor import train_dummy
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import declared_model, fit_stages
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.jobs.client import ArmClient
from longarm_comp.nodes.bringup import running
from longarm_comp.sim.arm_truth import TrueArm
from soak.faults import (
    BadImages,
    BreakFile,
    ClockFault,
    EmergencyStop,
    Fault,
    Flood,
    Freeze,
    Hold,
    Kill,
    LearningStopped,
    PathSent,
    RubbishParameters,
)
from soak.scene import Scene
from soak.setting import NAMESPACE, SoakSettings

Say = Callable[[str, float], None]
NOISE_M = 2e-4
"""Of the sightings that the model is of: a good camera's."""


def faults(setting: SoakSettings) -> list[Fault]:
    """All faults, each equally likely."""
    return [
        Kill("error_predictor"),
        Kill("stereo_bridge"),
        Kill("kinematics", quiet=True),
        Kill("servo_driver", quiet=True),
        BreakFile(setting.model),
        BreakFile(setting.predictor),
        EmergencyStop(),
        Hold(),
        Freeze("simulated_arm", 4.0),  # the servos and the cameras are silent: a driver fault
        Freeze("servo_driver", 1.0),
        Freeze("kinematics", 1.0),
        Kill("trajectory_compensator"),
        Freeze("trajectory_compensator", 1.0),
        Flood(),
        PathSent(),
        LearningStopped(),
        ClockFault("clock stands", rate=0.0),
        ClockFault("clock runs away", rate=10.0),
        ClockFault("clock jumps ahead", jump_s=100.0),
        ClockFault("clock jumps back", jump_s=-300.0),
        RubbishParameters(),
        BadImages(),
    ]


def soak(
    setting: SoakSettings, stop: threading.Event, say: Say = lambda text, share: None
) -> dict[str, Any]:
    """Run a soak test and return its report as plain data, with ``passed``.

    Raises:
        JobError: the graph did not come up.
        Interrupted: ``stop`` was set.
    """
    setting.out.mkdir(parents=True, exist_ok=True)
    arm = Arm.load(setting.arm)
    save_model(setting.model, store(_calibrated(arm, setting.seed)))
    train_dummy(arm, setting.predictor)
    rng = np.random.default_rng(setting.seed)
    whole = 3600.0 * setting.hours
    begun = time.monotonic()
    with _scene(setting, arm, stop, rng) as scene:
        scene.ready()
        begun = time.monotonic()
        kinds = faults(setting)
        order: list[int] = []
        while (gone := time.monotonic() - begun) < whole:
            say(f"{scene.ledger.sent} targets, {sum(scene.struck.values())} faults", gone / whole)
            pause = float(rng.exponential(setting.fault_s))
            scene.go_on(min(pause, max(whole - gone, 0.1)))
            if time.monotonic() - begun >= whole:
                continue
            order = order or rng.permutation(len(kinds)).tolist()
            fault = kinds[order.pop()]
            scene.struck[fault.name] += 1
            fault.strike(scene)
            if why := scene.recover():
                scene.ledger.wrong[f"no recovery after {fault.name}: {why}"] += 1
                break
        else:
            if why := scene.recover():
                scene.ledger.wrong[f"dead at the end: {why}"] += 1
        scene.audit()
        scene.ledger.close()
        return _report(scene, time.monotonic() - begun)


def _calibrated(arm: Arm, seed: int) -> Model:
    """A model that says how well it is known, of sightings of an arm as declared: it can learn."""
    rng = np.random.default_rng(seed)
    q = random_joints(arm, 60, rng)
    seen = TrueArm(arm).tip(q) + NOISE_M * rng.standard_normal((len(q), 3))
    rows = Session.record(q, seen)
    return with_uncertainty(dict(fit_stages(declared_model(arm), rows))["geometry"])


@contextmanager
def _scene(
    setting: SoakSettings, arm: Arm, stop: threading.Event, rng: np.random.Generator
) -> Iterator[Scene]:
    os.environ.setdefault("ROS_LOG_DIR", str(setting.out.absolute() / "log"))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    told: list[str] = []
    with ExitStack() as stack:
        supervisor = stack.enter_context(running(setting.graph(), say=told.append))
        ended = threading.Event()
        watch = threading.Thread(target=supervisor.run, args=(ended,), daemon=True)
        watch.start()
        stack.callback(watch.join, 5.0)
        stack.callback(ended.set)
        client = stack.enter_context(ArmClient(arm, NAMESPACE, stop, "soak"))
        yield Scene(setting, arm, supervisor, client, rng, told)


def _report(scene: Scene, seconds: float) -> dict[str, Any]:
    ledger, growth = scene.ledger, scene.leaks.growth()
    deaths = Counter(text.split()[0] for text in scene.told if " ended " in text)
    crashes = {name: n - scene.expected_deaths[name] for name, n in deaths.items()}
    crashes = {name: n for name, n in crashes.items() if n > 0}
    return {
        "passed": not ledger.wrong and not crashes and not any(g.leaks for g in growth),
        "seconds": seconds,
        "targets": ledger.sent,
        "held_back": scene.held_back,
        "trajectories": ledger.trajectories,
        "answers_by_status": dict(sorted(ledger.answered.items())),
        "refusals": dict(ledger.reasons),
        "faults": dict(scene.struck),
        "wrong": dict(ledger.wrong),
        "crashes": crashes,
        "driver_resets": scene.resets.total(),
        "driver_faults": dict(scene.resets),
        "learned_from": scene.learned_from,
        "driver_refusals": scene.driver_refusals,
        "growth": [{**vars(g), "leaks": g.leaks} for g in growth],
        "leaks_judged": sum(g.judged for g in growth),
        "seed": scene.setting.seed,
    }
