"""Where on the arm a finding is: its stations in one posture, for the picture of its card."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.core.model.outline import outline
from longarm_comp.core.model.tip_motion import stack
from longarm_comp.report.detail import Marked


def marked(diagnosis: Diagnosis) -> tuple[Marked, ...]:
    """The arm at the held-out row that stretches it most, with the places of each finding.

    Causes without a name that are in the model come last.
    """
    found = [f.terms for f in diagnosis.findings]
    found += [cause.terms for cause in diagnosis.causes]
    if not found:
        return ()
    rows, model = diagnosis.held_out, diagnosis.model
    tips = model.tip(rows.q, rows.context())
    row = int(np.linalg.norm(tips - tips.mean(axis=0), axis=1).argmax())
    context, q = rows.context().take(row), rows.q[row]
    line, posture = outline(model, q, context), model.posture(unstack(q), context)
    return tuple(Marked(line, _places(terms, model, posture, context)) for terms in found)


def _places(
    terms: tuple[Effect | Bias, ...], model: Model, posture: Posture, context: Context
) -> dict[str, np.ndarray]:
    points: dict[str, list[np.ndarray]] = {}
    for term in terms:
        points.setdefault(term.where, []).extend(_points(term, model, posture, context))
    return {where: np.mean(held, axis=0) for where, held in points.items()}


def _points(
    term: Effect | Bias, model: Model, posture: Posture, context: Context
) -> list[np.ndarray]:
    """The stations that it turns or moves; of a camera, the camera; else the tip."""
    camera = model.arm.camera
    if isinstance(term, Bias):
        known = None if camera is None else [np.array(camera.position_m, dtype=float)]
        return known or [stack(model.tip_frame(posture).p)]
    stations = [posture.bearing(joint) for joint in term.joints]
    stations = stations or [k for k in term.twists(posture) if k >= 0]
    return [stack(posture.frames[k].p) for k in stations] or [stack(model.tip_frame(posture).p)]
