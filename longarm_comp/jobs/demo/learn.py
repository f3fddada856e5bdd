"""From the collected bag to model.yaml and the predictor, with the package's own core."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from longarm_comp.core.admission import admit
from longarm_comp.core.arm import Arm
from longarm_comp.core.dataset import Session
from longarm_comp.core.holdout import blocked_split
from longarm_comp.core.identify.calibrate import Rung, errors, ladder
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import Provenance
from longarm_comp.core.model import Model
from longarm_comp.core.modelfile import save_model, store
from longarm_comp.jobs.demo.setting import Setting
from longarm_comp.sessions.read import read_session
from longarm_comp.sessions.residual_inputs import predictor_context

Say = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Learned:
    """What the session gave: rows, the held-out ladder, the model and its predictor's inputs."""

    session: Session
    rungs: list[Rung]
    model: Model
    inputs: tuple[str, ...]


def learn(setting: Setting, arm: Arm, say: Say = lambda text, share: None) -> Learned:
    """Calibrate and train on the bag; writes both files."""
    session = admit(read_session(setting.bag, arm), arm).session
    training, held_out = blocked_split(session, rng=setting.seed)
    rungs = ladder(arm, training, held_out, progress=lambda name: say(f"calibrate {name}", 0.2))
    final = fit(rungs[-1].model, session)
    provenance: dict[str, str | int | float] = {
        "session_hash": session.hash, "session": str(setting.bag), "rows": len(session),
    }  # fmt: skip
    save_model(setting.model, store(final.model, final.standard_errors, provenance=provenance))
    seen = session.take(session.seen)
    made = train(
        seen.q,
        errors(final.model, seen),
        predictor_context(seen),
        seed=setting.seed,
        ensemble=setting.networks,
        progress=lambda k, of: say("train", 0.3 + 0.7 * k / of),
        provenance=Provenance(arm.hash, session.hash, arm.joint_names, {"deflection": True}),
    )
    made.save(setting.predictor)
    return Learned(session, rungs, final.model, tuple(made.encoding.names))
