"""What moves the rows besides an explanation, and is no finding.

No effect's form is exact.  And every real arm gives way everywhere, and all else is a little off.
The latter is the infinitesimal part beside a sum of single effects (Cui et al. 2024, "Improving
fine-mapping by modeling infinitesimal effects", Nature Genetics 56): what is found must explain
more than it does.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.context import PER_JOINT
from longarm_comp.core.calibration.candidates import Candidate, Term, distinct
from longarm_comp.core.calibration.fit import fit
from longarm_comp.core.calibration.fit_columns import FitColumns, shift_of
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.model.model import slots_of

GIVE = 0.03
"""Size of what gives way at every place of an arm, in the size of a finding.  On UR5 and three
Pandas (1, 4, 6) the evidence for it is highest at 0.1 to 0.3; at 0.1 it also stands for single soft
parts, whose names are lost (`test_explain.py`), and real test rows err no less than at 0.03."""
LITTLE = 0.005
"""Size of everything else at every place.  Beside what was found on Justin and UR5 the evidence is
highest at 0.005 to 0.008."""


OF_NOISE = 0.1
"""Share of the noise below which what is a little off is not in the model: nobody would see it."""


class Slack(NamedTuple):
    """What may move the rows besides an explanation, and is no finding.

    Attributes:
        form: share of its own shift by which the form of an effect in the model may err.
        give: how much every part gives way, as a share of `GIVE`, and so what gives way more than
            that: the parts of one arm are stiff alike. 0: only what is found gives way.
    """

    form: float
    give: float

    @property
    def stiffness(self) -> float:
        """Size of an elastic effect that is found, as a share of its prior."""
        return self.give or 1.0


FORMS = (0.01, 0.03, 0.1)
"""Shares of its own shift by which an effect's form may err, equally likely beforehand: play,
friction and stiffness of real joints differ by a tenth from place to place along their way."""
SCALES = (1.0, 0.125, 0.0)
"""How much every part of an arm gives way, equally likely beforehand: arms of plastic and of steel
differ by ten, the parts of one arm by less."""
TOLERANCES = tuple(Slack(form, give) for form in FORMS for give in SCALES)
"""Each as likely as the others; the first of each scale where nothing is in the model."""


def little(library: Sequence[Candidate]) -> tuple[Term, ...]:
    """What every real arm has, in every form; the same physics by another name left out."""
    names = {candidate.name for candidate in library}
    return tuple(t for t in distinct(library) if names.isdisjoint(t.aliases))


def a_little(columns: FitColumns, library: Sequence[Candidate]) -> tuple[np.ndarray, np.ndarray]:
    """(m, k) whitened columns of what every real arm has, and (k,) the size of each.

    The forms of an effect at a place share its size.
    """
    every = little(library)
    forms = Counter(t.key for t in every)
    slots = slots_of(columns.model.arm, every)
    sizes = [_size(s.owner) for s in slots]
    return columns.white(every), sizes / np.sqrt([forms[s.owner.key] for s in slots])


def with_give(fitted: ModelFit, library: Sequence[Candidate], give: float = 1.0) -> ModelFit:
    """A fit with what every arm has besides, as much as the rows ask for; same rows and noise.

    That is every effect of the arm that reads no recorded column, in its first form, where it
    moves the rows by `OF_NOISE` at least.
    """
    held = {t.key for t in fitted.model.terms}
    added: dict[tuple[str, str], Term] = {}
    for t in little(library):
        wanted = isinstance(t, Effect) and set(t.inputs) <= set(PER_JOINT)
        if wanted and t.key not in held and slots_of(fitted.model.arm, [t]):
            added.setdefault(t.key, t)
    every = _with(fitted, added, give)
    columns, terms = FitColumns(every), {t.key: t for t in every.model.terms}
    moved = {
        key: every.whitened(shift_of(every, columns, [terms[key]])[..., None]) for key in added
    }
    seen = {k: t for k, t in added.items() if np.sqrt((moved[k] ** 2).mean()) >= OF_NOISE}
    return _with(fitted, seen, give)


def _with(fitted: ModelFit, added: Mapping[tuple[str, str], Term], give: float) -> ModelFit:
    model = fitted.model.plus(*added.values())
    small = tuple((s.identity, give * _size(s.owner)) for s in model.slots if s.owner.key in added)
    model = dataclasses.replace(model, beyond=(*model.beyond, *small))
    return fit(model, fitted.session, near=fitted, **fitted.judged)


def _size(owner: Term) -> float:
    return GIVE if owner.elastic else LITTLE
