"""From the collected bag to model.yaml and the predictor, with the package's own core."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.admission import admit
from longarm_comp.core.data.holdout import blocked_split
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import JobError
from longarm_comp.core.identify.calibrate import Rung, errors, ladder
from longarm_comp.core.identify.diagnosis import diagnose
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import Provenance
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.jobs.demo.setting import Setting
from longarm_comp.nodes.model_files import file_hash
from longarm_comp.sessions.read import read_session

Say = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Learned:
    """What the session gave: rows, the held-out ladder, what was found, the predictor's inputs."""

    session: Session
    rungs: list[Rung]
    finding: str
    effects: tuple[str, ...]
    inputs: tuple[str, ...]


def learn(setting: Setting, arm: Arm, say: Say = lambda text, share: None) -> Learned:
    """Calibrate, look for the effect that nobody declared, train on the rest; writes both files."""
    session = admit(read_session(setting.bag, arm), arm).session
    training, held_out = blocked_split(session, rng=setting.seed)
    rungs = ladder(arm, training, held_out, progress=lambda name: say(f"calibrate {name}", 0.1))
    model, finding = _diagnosed(setting, arm, session, rungs[-1].model, say)
    final = fit(model, session)
    provenance: dict[str, str | int | float] = {
        "session_hash": session.hash, "session": str(setting.bag), "rows": len(session),
        "verdict": finding,
    }  # fmt: skip
    save_model(setting.model, store(final.model, final.standard_errors, provenance=provenance))
    seen = session.take(session.seen)
    trained_on = {"deflection": True, "model_hash": file_hash(setting.model)}
    made = train(
        seen.q,
        errors(final.model, seen),
        seen.context(),
        seed=setting.seed,
        ensemble=setting.networks,
        progress=lambda k, of: say("train", 0.6 + 0.4 * k / of),
        provenance=Provenance(arm.hash, session.hash, arm.joint_names, trained_on),
    )
    made.save(setting.predictor)
    effects = tuple(dict.fromkeys(e.name for e in final.model.effects if not e.geometry))
    return Learned(session, rungs, finding, effects, tuple(made.encoding.names))


def _diagnosed(
    setting: Setting, arm: Arm, session: Session, calibrated: Model, say: Say
) -> tuple[Model, str]:
    """The model with what the diagnosis added, and its sentence; else the calibrated one."""
    if not setting.diagnosis_s:
        return calibrated, "no diagnosis was asked for"
    end = time.monotonic() + setting.diagnosis_s

    def step(name: str) -> None:
        say(f"diagnose: {name}", 0.3)
        if time.monotonic() > end:
            raise JobError(f"it took longer than {setting.diagnosis_s:g} s")

    try:
        found = diagnose(arm, session, seed=setting.seed, progress=step)
    except JobError as error:
        return calibrated, f"no diagnosis: {error}"
    return found.model, f"{found.verdict}: {found.summary}"
