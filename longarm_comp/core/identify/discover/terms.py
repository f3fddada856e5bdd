"""What was found as terms of a model, and the fit with them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify import noise as noise_step
from longarm_comp.core.identify.discover.bank import Weighed
from longarm_comp.core.identify.discover.banks import term_of
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import NoiseEstimate
from longarm_comp.core.model.model import Model

NEAR = 0.3
"""The last step of a fit that only the noise is judged by, in standard errors."""
STEPS = 6
"""Gauss-Newton steps of each fit."""

Term = Effect | Bias


def key_of(term: Term) -> tuple[str, str]:
    """An effect at a place, with its function."""
    return term.name, term.place


def terms_of(group: Weighed) -> list[Term]:
    """The terms of a model that a group stands for."""
    return [
        term_of(place, f.text, f.domain, float(scale), float(amount))
        for (place, f), scale, amount in zip(
            group.candidate.members, group.scale, group.mean, strict=True
        )
    ]


def with_terms(base: Model, now: Model, groups: Sequence[Weighed]) -> Model:
    """The base with the groups' terms, started from the values of the model as it is now."""
    known = {key_of(t): t for t in now.terms}
    added = [t for g in groups for t in terms_of(g)]
    terms = [known.get(key_of(t), t) for t in (*base.terms, *added)]
    return dataclasses.replace(
        base,
        effects=tuple(t for t in terms if isinstance(t, Effect)),
        biases=tuple(t for t in terms if isinstance(t, Bias)),
    )


def refitted(
    model: Model, last: ModelFit, known: NoiseEstimate | None
) -> tuple[ModelFit, NoiseEstimate]:
    """Fit, noise and inliers judged by what it leaves, and fit again."""
    session = last.session
    first = fit(
        model,
        session,
        sigma=last.sigma,
        rho=last.rho,
        weights=last.weights,
        max_iterations=STEPS,
        close=NEAR,
        near=last,
    )
    nothing = np.zeros((*first.residual.shape, 0))
    judged, weights = noise_step.from_residual(first, nothing)
    if known is not None:
        judged = noise_step.agreed(known, judged)
    again = fit(
        first.model,
        session,
        sigma=judged.sigma,
        rho=judged.rho,
        weights=weights,
        max_iterations=STEPS,
        begun=first,
    )
    return again, judged


def part(group: Weighed, members: Sequence[int]) -> Weighed:
    """Some members of a group."""
    if len(members) == len(group.candidate.members):
        return group
    candidate = dataclasses.replace(
        group.candidate,
        members=tuple(group.candidate.members[i] for i in members),
        decay=tuple(group.candidate.decay[i] for i in members),
    )
    at = list(members)
    return Weighed(candidate, group.log_evidence, group.mean[at], group.scale[at])


def same(a: Sequence[Weighed], b: Sequence[Weighed]) -> bool:
    """Whether two lists of groups have the same members."""
    return [g.candidate.members for g in a] == [g.candidate.members for g in b]
