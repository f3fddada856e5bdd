"""From the collected bag to report, model and predictor: `longarm diagnose`, `longarm train`."""

from __future__ import annotations

from collections.abc import Callable

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.jobs.demo.settings import DemoSettings
from longarm_comp.workflows.diagnose import DiagnosisResult, diagnose_files
from longarm_comp.workflows.train import train

Say = Callable[[str, float], None]


def find_effects(settings: DemoSettings, arm: Arm, say: Say) -> DiagnosisResult:
    """Diagnose the session; writes model.yaml, report.html and report.json."""
    return diagnose_files(
        arm, settings.bag, settings.out, seed=settings.seed, network=False,
        progress=lambda step: say(f"diagnose: {step}", 0.3),
    )  # fmt: skip


def train_network(settings: DemoSettings, arm: Arm, say: Say) -> Predictor:
    """Train on what the diagnosed model leaves of the session; writes the predictor."""
    predictor = train(
        arm, settings.bag, model=settings.model, seed=settings.seed,
        progress=lambda text, share: say(f"train: {text}", 0.6 + 0.4 * share),
    )  # fmt: skip
    predictor.save(settings.predictor)
    return predictor
