"""The model tolerance: what moves the rows besides an explanation, and is no finding.

The form of no effect is exact. And every part of a real arm yields and errs a little. The latter is
the infinitesimal part beside a sum of single effects (Cui et al. 2024, "Improving fine-mapping by
modeling infinitesimal effects", Nature Genetics 56): a finding must explain more than it does.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.context import PER_JOINT
from longarm_comp.core.calibration.candidates import Candidate, Term, distinct_terms
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.identify.posterior.found import NONE, UNNAMED
from longarm_comp.core.model.model import slots_of

BACKGROUND_COMPLIANCE = 0.03
"""Size of what gives way at every place of an arm, in the size of a finding.  On UR5 and three
Pandas (1, 4, 6) the evidence for it is highest at 0.1 to 0.3; at 0.1 it also stands for single soft
parts, whose names are lost (`test_explain.py`), and real test rows err no less than at 0.03."""
BACKGROUND_REST = 0.005
"""Size of everything else at every place.  Beside what was found on Justin and UR5 the evidence is
highest at 0.005 to 0.008."""


OF_NOISE = 0.1
"""Share of the noise below which what is a little off is not in the model: nobody would see it."""


class ModelTolerance(NamedTuple):
    """An assumption on what moves the rows besides an explanation, and is no finding.

    Attributes:
        form: share of its own shift by which the form of an effect in the model may err.
        compliance: how much every part yields, as a share of `BACKGROUND_COMPLIANCE`. A finding
            that yields must exceed it, because the parts of one arm are stiff alike. 0: only what
            is found yields.
    """

    form: float
    compliance: float

    @property
    def is_soft(self) -> bool:
        """True where every part yields by more than a little, which is a cause without a name."""
        return self.compliance in SOFT

    @property
    def log_prior(self) -> float:
        """Log prior relative to that of an arm whose parts yield by no more than a little."""
        return math.log(UNNAMED / len(SOFT) / FUNCTIONS) - NONE if self.is_soft else 0.0

    @property
    def elastic_share(self) -> float:
        """Size of an elastic effect that is found, as a share of its prior."""
        return min(self.compliance, 1.0) or 1.0


FORMS = (0.01, 0.03, 0.1)
"""Shares of its own shift by which an effect's form may err, equally likely beforehand: play,
friction and stiffness of real joints differ by a tenth from place to place along their way."""
STIFF = (1.0, 0.125, 0.0)
"""How much every part of an arm gives way, equally likely beforehand: arms of plastic and of steel
differ by ten, the parts of one arm by less."""
SOFT = (16.0, 4.0)
"""The same where all parts yield by up to half of what a soft part does: then the arm has no soft
part.  That is a cause without a name, and costs what a function costs."""
FUNCTIONS = 1000
"""About so many functions without a name are on offer, one as likely as the other."""
TOLERANCES = tuple(ModelTolerance(form, share) for form in FORMS for share in (*STIFF, *SOFT))
"""Each as likely as the others but for `ModelTolerance.log_prior`."""
RIGID = ModelTolerance(FORMS[0], 0.0)
"""Only what is found gives way."""


def list_background_terms(library: Sequence[Candidate]) -> tuple[Term, ...]:
    """List the terms of what every real arm has a little of, in every form.

    Of two names for the same physics only one is listed.
    """
    names = {candidate.name for candidate in library}
    return tuple(t for t in distinct_terms(library) if names.isdisjoint(t.aliases))


def background_columns(
    columns: FitColumns, library: Sequence[Candidate], tolerances: Sequence[ModelTolerance]
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the columns of what every real arm has a little of.

    The forms of an effect at a place share its size.

    Returns:
        (m, k) whitened columns, and (S, k) their sizes by each of S tolerances.
    """
    every = list_background_terms(library)
    forms = Counter(t.key for t in every)
    slots = slots_of(columns.model.arm, every)
    sizes = [
        [_background_size(s.owner, tolerance.compliance) for s in slots] for tolerance in tolerances
    ]
    return columns.white_columns(every), sizes / np.sqrt([forms[s.owner.key] for s in slots])


def fit_with_background(
    fitted: ModelFit, library: Sequence[Candidate], compliance: float = 1.0
) -> ModelFit:
    """Fit again with what every arm has a little of, as much as the rows ask for; same rows and
    noise.

    Added is every effect of the arm that reads no recorded column, in its first form, if it moves
    the rows by at least `OF_NOISE`. For an elastic effect it is enough that it may move them by so
    much: under another load it would, and the model's `sigma` counts it.
    """
    held = {t.key for t in fitted.model.terms}
    added: dict[tuple[str, str], Term] = {}
    for t in list_background_terms(library):
        wanted = isinstance(t, Effect) and set(t.inputs) <= set(PER_JOINT)
        if wanted and t.key not in held and slots_of(fitted.model.arm, [t]):
            added.setdefault(t.key, t)
    every = _fit_with(fitted, added, compliance)
    columns, terms = FitColumns(every), {t.key: t for t in every.model.terms}
    moved = {
        key: columns.white_columns([terms[key]]) * _background_size(terms[key], compliance)
        if terms[key].elastic
        else every.whiten_columns(columns.shift_by([terms[key]])[..., None])
        for key in added
    }
    size = {key: np.sqrt((each**2).sum(axis=1).mean()) for key, each in moved.items()}
    return _fit_with(fitted, {k: t for k, t in added.items() if size[k] >= OF_NOISE}, compliance)


def _fit_with(
    fitted: ModelFit, added: Mapping[tuple[str, str], Term], compliance: float
) -> ModelFit:
    model = fitted.model.plus(*added.values())
    small = tuple(
        (s.identity, _background_size(s.owner, compliance))
        for s in model.slots
        if s.owner.key in added
    )
    model = dataclasses.replace(model, beyond=(*model.beyond, *small))
    return fit_model(model, fitted.session, near=fitted, **fitted.noise_arguments)


def _background_size(owner: Term, compliance: float) -> float:
    """Return the size of a background parameter as a share of its prior.

    A soft arm is softer everywhere, but its other errors are no larger.
    """
    return (
        BACKGROUND_COMPLIANCE * compliance
        if owner.elastic
        else BACKGROUND_REST * min(compliance, 1.0)
    )
