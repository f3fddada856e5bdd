"""From the collected bag to report, model and predictor: `longarm diagnose`, `longarm train`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.admission import admit
from longarm_comp.core.identify.calibrate import errors
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import Predictor, Provenance
from longarm_comp.core.model.model_file import load_model
from longarm_comp.jobs import diagnose
from longarm_comp.jobs.demo.settings import DemoSettings
from longarm_comp.nodes.model_files import file_hash
from longarm_comp.sessions.read import read_session

Say = Callable[[str, float], None]


def find_effects(settings: DemoSettings, arm: Arm, say: Say) -> dict[str, Any]:
    """Diagnose the session; writes model.yaml, report.html and report.json, which is returned."""
    request = diagnose.Request(arm, settings.bag, seed=settings.seed, network=False)
    return diagnose.run(request, settings.out, lambda step: say(f"diagnose: {step}", 0.3))


def train_network(settings: DemoSettings, arm: Arm, say: Say) -> Predictor:
    """Train on what the diagnosed model leaves of the session; writes the predictor."""
    model = load_model(settings.model, arm)
    session = admit(read_session(settings.bag, arm), arm, model).session
    seen = session.take(session.seen)
    trained_on = {"deflection": True, "model_hash": file_hash(settings.model)}
    predictor = train(
        seen.q,
        errors(model, seen),
        seen.context(),
        seed=settings.seed,
        progress=lambda k, of: say("train", 0.6 + 0.4 * k / of),
        provenance=Provenance(arm.hash, session.hash, arm.joint_names, trained_on),
    )
    predictor.save(settings.predictor)
    return predictor
