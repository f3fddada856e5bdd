"""What moves the rows besides an explanation, and is no finding.

No effect's form is exact.  And every real arm gives way everywhere, and all else is a little off.
The latter is the infinitesimal part beside a sum of single effects (Cui et al. 2024, "Improving
fine-mapping by modeling infinitesimal effects", Nature Genetics 56): what is found must explain
more than it does.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from longarm_comp.core.calibration.candidates import Candidate, Term, distinct
from longarm_comp.core.calibration.fit import fit
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.model.model import slots_of

GIVE = 0.03
"""Size of what gives way at every place of an arm, in the size of a finding.  On UR5 and three
Pandas (1, 4, 6) the evidence for it is highest at 0.1 to 0.3; at 0.1 it also stands for single soft
parts, whose names are lost (`test_explain.py`), and real test rows err no less than at 0.03."""
LITTLE = 0.005
"""Size of everything else at every place.  Beside what was found on Justin and UR5 the evidence is
highest at 0.005 to 0.008."""


class Slack(NamedTuple):
    """What may move the rows besides an explanation, and is no finding.

    Attributes:
        form: share of its own shift by which the form of an effect in the model may err.
        give: whether every part gives way a little, as in real arms.
    """

    form: float
    give: bool


FORMS = (0.01, 0.03, 0.1)
"""Shares of its own shift by which an effect's form may err, equally likely beforehand: play,
friction and stiffness of real joints differ by a tenth from place to place along their way."""
TOLERANCES = tuple(Slack(form, give) for form in FORMS for give in (True, False))
"""Each as likely as the others; the first two where nothing is in the model."""


def giving(library: Sequence[Candidate]) -> tuple[Term, ...]:
    """The places that give way in every arm."""
    return tuple(t for t in distinct(library) if t.elastic)


def a_little(columns: FitColumns, library: Sequence[Candidate]) -> tuple[np.ndarray, np.ndarray]:
    """(m, k) whitened columns of what every real arm has, and (k,) the size of each.

    The forms of an effect at a place share its size; the same physics by another name has none.
    """
    names = {candidate.name for candidate in library}
    every = [t for t in distinct(library) if names.isdisjoint(t.aliases)]
    forms = Counter(t.key for t in every)
    slots = slots_of(columns.model.arm, every)
    sizes = [GIVE if s.owner.elastic else LITTLE for s in slots]
    return columns.white(every), sizes / np.sqrt([forms[s.owner.key] for s in slots])


def with_give(fitted: ModelFit, library: Sequence[Candidate]) -> ModelFit:
    """A fit with what gives way besides, as much as the rows ask for; same rows and noise."""
    held = {t.key for t in fitted.model.terms}
    added = [t for t in giving(library) if t.key not in held]
    model = fitted.model.plus(*added)
    keys = {t.key for t in added}
    small = tuple((s.identity, GIVE) for s in model.slots if s.owner.key in keys)
    model = dataclasses.replace(model, beyond=(*model.beyond, *small))
    return fit(
        model, fitted.session, sigma=fitted.sigma, rho=fitted.rho, weights=fitted.weights,
        near=fitted,
    )  # fmt: skip
