"""The search: which effects the data ask for, by evidence, with the geometry marginalised.

Forward by the largest Bayes factor, the geometry refitted jointly each time and never
frozen; outliers and noise are judged anew after every accepted effect, so that structure is
not thrown out as noise; then forms are sharpened, two effects at one place that one effect
explains are merged, families swapped or split in two, and a backward pass drops what no longer
pays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.candidates import Candidate, Term
from longarm_comp.core.identify.evidence import Score, key
from longarm_comp.core.identify.fit import Fit, fit
from longarm_comp.core.identify.moves import merge, split, swap
from longarm_comp.core.identify.noise import Noise
from longarm_comp.core.identify.search_state import State
from longarm_comp.core.model.model import Model

ROUNDS = 4


@dataclass(frozen=True)
class SearchResult:
    """The outcome of a search.

    Attributes:
        fit: the final model, fitted.
        base: the model without any found effect.
        chosen: the terms found, by place.
        noise: as judged last.
        first: every candidate's score before anything was added.
        last: every candidate's score on top of what was added.
        threshold: log Bayes factor that a candidate had to reach.
        exhausted: the residual asked for more effects than were allowed: it is something else.
    """

    fit: Fit
    base: Model
    chosen: tuple[Term, ...]
    noise: Noise
    first: tuple[Score, ...]
    last: tuple[Score, ...]
    threshold: float
    exhausted: bool = False


def search(
    base: Model,
    session: Session,
    candidates: Sequence[Candidate],
    *,
    known_noise: Noise | None = None,
    progress: Callable[[str], None] | None = None,
) -> SearchResult:
    """Find what the model lacks.

    Args:
        base: the declared model with its geometry terms.
        session: training rows.
        candidates: hypotheses.
        known_noise: from repeats; judged from the residual otherwise.
        progress: told what is going on.

    Raises:
        InputError, JobError: as `fit`.
    """
    say = progress or (lambda _: None)
    state = State(base, session, candidates, known_noise)
    say("geometry")
    state.refit()
    first = state.scores()
    for _ in range(ROUNDS):
        state.grow(say)
        if state.exhausted:
            state.prune()
            break
        changed = state.sharpen(say) | merge(state, say) | swap(state, say) | state.prune()
        if not (changed or split(state, say)):
            break
    state.settle()
    return SearchResult(
        state.fit,
        base,
        tuple(state.chosen.values()),
        state.noise,
        first,
        state.scores(),
        state.threshold,
        state.exhausted,
    )


def dropped(traced: SearchResult, places: set[tuple[str, str]]) -> SearchResult:
    """The same search with some of the found terms taken out again, the rest refitted."""
    was = traced.fit
    kept = fit(
        dataclasses.replace(
            was.model,
            effects=tuple(t for t in was.model.effects if key(t) not in places),
            biases=tuple(t for t in was.model.biases if key(t) not in places),
        ),
        was.session,
        sigma=was.sigma,
        rho=was.rho,
        weights=was.weights,
    )
    chosen = tuple(t for t in traced.chosen if key(t) not in places)
    return dataclasses.replace(traced, fit=kept, chosen=chosen)
