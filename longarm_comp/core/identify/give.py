"""What every arm gives way by: joints, seats and links are stiff, and none is rigid."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from longarm_comp.core.identify.candidates import Candidate, Term, distinct
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.model_fit import ModelFit

GIVE = 0.1
"""Size of what gives way at every place of an arm, in the size of a finding.  On eight stiff real
arms (UR5, six Pandas, a WAM's stiffer parts) the evidence is highest at 0.1 to 0.3, and test rows
err less on each of them, though no single place can be named."""


def giving(library: Sequence[Candidate]) -> tuple[Term, ...]:
    """The places that give way in every arm."""
    return tuple(t for t in distinct(library) if t.elastic)


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
