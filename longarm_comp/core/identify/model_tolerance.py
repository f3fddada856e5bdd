"""The model tolerance: small errors of every real arm that are no finding.

The form of no effect is exact, and every part of a real arm yields and errs a little. These small
effects at all places are like the infinitesimal part beside a sum of single effects (Cui et al.
2024, "Improving fine-mapping by modeling infinitesimal effects", Nature Genetics 56). A finding
must explain more than they can.
"""

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
from longarm_comp.core.calibration.linear import SIZES
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.identify.posterior.found import NONE, UNNAMED
from longarm_comp.core.model.model import slots_of

BACKGROUND_COMPLIANCE = 0.03
"""Size of the background compliance at every place of an arm, as a share of the prior of a finding.
On UR5 and three Pandas (1, 4, 6) the evidence is highest at 0.1 to 0.3. But at 0.1 it also explains
single soft parts, whose names are then lost (`test_explain.py`), and held-out rows of real arms are
predicted no better than at 0.03."""
BACKGROUND_REST = 0.005
"""The same share for all effects that are not elastic.  Beside the findings on Justin and UR5 the
evidence is highest at 0.005 to 0.008."""

OF_NOISE = 0.1
"""Shift of the rows, as a share of the noise, below which a background effect is left out of the
model."""


class ModelTolerance(NamedTuple):
    """One assumption on the small errors of an arm that are no finding.

    Attributes:
        form: error of the form of each effect in the model, as a share of its own shift.
        compliance: compliance of every part of the arm, in units of `BACKGROUND_COMPLIANCE`. An
            elastic finding must exceed it, because the parts of one arm are about equally stiff. 0:
            only parts that are found yield.
    """

    form: float
    compliance: float

    @property
    def is_soft(self) -> bool:
        """True if every part yields by much (`SOFT`), which counts as a cause without a name."""
        return self.compliance in SOFT

    @property
    def log_prior(self) -> float:
        """Log prior, relative to that of an arm whose parts yield only a little."""
        return math.log(UNNAMED / len(SOFT) / FUNCTIONS) - NONE if self.is_soft else 0.0


FORMS = (0.01, 0.03, 0.1)
"""Possible values of `ModelTolerance.form`, equally likely beforehand. Play, friction and stiffness
of real joints differ by a tenth between positions of the joint."""
_, FORM_KNOWN_WITHIN, _ = FORMS
"""Share of its shift to which the form of a real joint is usually known. Two functions that differ
by less are one."""
STIFF = (1.0, 0.125, 0.0)
"""Possible values of `ModelTolerance.compliance`, equally likely beforehand. Arms of plastic and of
steel differ by a factor of ten, the parts of one arm by less."""
SOFT = tuple(sorted(set(SIZES) - set(STIFF), reverse=True))
"""Further values, the sizes above the usual one: all parts yield by up to half of a soft part, and
no single part is to blame.  This counts as a cause without a name and has the prior of a
function."""
FUNCTIONS = 1000
"""Rough number of functions without a name on offer, equally likely: only its logarithm counts, and
half or twice of it changes the log odds by less than 1."""
TOLERANCES = tuple(ModelTolerance(form, share) for form in FORMS for share in (*STIFF, *SOFT))
"""All tolerances that are tried; their priors are `ModelTolerance.log_prior`."""
RIGID = ModelTolerance(min(FORMS), min(STIFF))
"""The tolerance without background compliance."""


def list_background_terms(library: Sequence[Candidate]) -> tuple[Term, ...]:
    """List the terms of all background effects, of which every real arm has a little.

    They are those of the library in every form. Of two names for the same physics one is listed.
    """
    names = {candidate.name for candidate in library}
    return tuple(t for t in distinct_terms(library) if names.isdisjoint(t.aliases))


def background_columns(
    columns: FitColumns, library: Sequence[Candidate], tolerances: Sequence[ModelTolerance]
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the columns of all background effects.

    The variance of an effect at a place is divided among its forms.

    Returns:
        (m, k) whitened columns, and (S, k) their sizes at each of S tolerances.
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
    """Return a fit with background effects, to the same rows and with the same noise.

    Every effect on the arm that reads no recorded column is added, in its first form, if it moves
    the rows by at least `OF_NOISE`. For an elastic effect its prior size decides, not the fitted
    one, because under another load it may move the tip more; the model's `sigma` includes this.
    The compliance is that of `ModelTolerance`.
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
    """Return the size of a background effect's parameters, as a share of their priors."""
    if owner.elastic:
        return BACKGROUND_COMPLIANCE * compliance
    return BACKGROUND_REST * min(compliance, 1.0)  # the softest arm errs no more
