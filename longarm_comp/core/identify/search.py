"""The search: which effects the data ask for, by evidence, with the geometry marginalised.

Forward by the largest Bayes factor, the geometry refitted jointly each time and never
frozen; outliers and noise are judged anew after every accepted effect, so that structure is
not thrown out as noise; then forms are refined, two effects at one place that one effect
explains are merged, families swapped or split in two, and a backward pass drops what no longer
pays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.identify.candidates import Candidate, Term
from longarm_comp.core.identify.evidence import FitMarginal, Score, columns_at, key, reshaped, score
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import NoiseEstimate
from longarm_comp.core.identify.search_state import SearchState
from longarm_comp.core.identify.step_scan import UnknownStep
from longarm_comp.core.model.model import Model

ROUNDS = 4


@dataclass(frozen=True)
class SearchResult:
    """The outcome of a search.

    Attributes:
        fit: the final model, fitted.
        chosen: the terms found, by place.
        noise: as judged last.
        first: every candidate's score before anything was added.
        last: every candidate's score on top of what was added.
        threshold: log Bayes factor that a candidate had to reach.
        exhausted: the residual asked for more effects than were allowed: it is something else.
        unknown_steps: where steps show, but not their size.
    """

    fit: ModelFit
    chosen: tuple[Term, ...]
    noise: NoiseEstimate
    first: tuple[Score, ...]
    last: tuple[Score, ...]
    threshold: float
    exhausted: bool = False
    unknown_steps: tuple[UnknownStep, ...] = ()

    def without(self, places: set[tuple[str, str]]) -> SearchResult:
        """The same search with some of the found terms taken out again, the rest refitted.

        These are candidates again, scored last.
        """
        was = self.fit
        model = dataclasses.replace(
            was.model,
            effects=tuple(t for t in was.model.effects if key(t) not in places),
            biases=tuple(t for t in was.model.biases if key(t) not in places),
        )
        refitted = fit(
            model, was.session, sigma=was.sigma, rho=was.rho, weights=was.weights, near=was
        )
        chosen = tuple(t for t in self.chosen if key(t) not in places)
        columns, marginal = columns_at(refitted), FitMarginal(refitted)
        gone = [Candidate(t.name, (t,)) for t in self.chosen if key(t) in places]
        again = [score(refitted, marginal, each, columns) for each in gone]
        return dataclasses.replace(self, fit=refitted, chosen=chosen, last=(*self.last, *again))


def search(
    base: Model,
    session: Session,
    candidates: Sequence[Candidate],
    *,
    known_noise: NoiseEstimate | None = None,
    stepped: Sequence[type[Effect]] = (),
    progress: Callable[[str], None] | None = None,
) -> SearchResult:
    """Find what the model lacks.

    Args:
        base: the declared model with its geometry terms.
        session: training rows.
        candidates: hypotheses.
        known_noise: from repeats; judged from the residual otherwise.
        stepped: effects whose steps are scanned.
        progress: told what is going on.

    Raises:
        InputError, JobError: as `fit`.
    """
    say = progress or (lambda _: None)
    state = SearchState(base, session, candidates, known_noise, stepped)
    say("geometry")
    state.refit()
    state.scan_steps()
    first = state.scores()
    for _ in range(ROUNDS):
        state.grow(say)
        if state.chosen and not state.exhausted and state.scan_steps():
            state.grow(say)
        if state.exhausted:
            state.prune()
            break
        changed = state.refine_forms(say) | state.retune(say)
        changed |= merge(state, say) | swap(state, say) | state.prune()
        if not (changed or split(state, say)):
            break
    state.settle()
    return SearchResult(
        state.fit,
        tuple(state.chosen.values()),
        state.noise,
        first,
        state.scores(),
        state.threshold,
        state.exhausted,
        tuple(state.unknown_steps.values()),
    )


SWAP = 1.0
"""A new name must be this much (log) more probable than the one it replaces."""
COARSE = 50.0
"""A form this much (log) worse than the best may still win once its scale is refined."""
PAIRED = 6
"""Names, the best ones, of which every two are tried together in the place of one."""


def merge(state: SearchState, say: Callable[[str], None]) -> bool:
    """Where two effects sit at one place, let one of them do, in another form if need be."""
    merged = False
    for where in dict.fromkeys(t.where for t in state.chosen.values()):
        places = [k for k, t in state.chosen.items() if t.where == where]
        if len(places) < 2:
            continue
        now = state.score(
            state.marginal(places), Candidate("", tuple(state.chosen[p] for p in places))
        )
        names = {name for name, _ in places}
        first: dict[str, Score] = {}
        for single in state.scores(places):
            close = single.log_bayes_factor > now.log_bayes_factor - COARSE
            if close and single.candidate.name in names and single.candidate.where == (where,):
                first.setdefault(single.candidate.name, single)
        options = [state.best_form(s.candidate.terms[0], places) for s in first.values()]
        best = max(options, key=lambda s: s.log_bayes_factor, default=None)
        if best is not None and best.log_bayes_factor >= now.log_bayes_factor:
            say(f"{best.candidate.label} alone")
            state.replace(places, best)
            merged = True
    return merged


def swap(state: SearchState, say: Callable[[str], None]) -> bool:
    """Replace a family by a better one, a better form, or more places of another that is there."""
    changed = False
    for name in dict.fromkeys(name for name, _ in state.chosen):
        if name not in state.names(()):
            continue  # pruned while others were replaced
        places, marginal, now = state.family(name)
        terms = now.candidate.terms
        shaped = [state.score(marginal, c) for c in reshaped(terms, state.candidates)]
        surplus = now.log_bayes_factor - state.threshold
        whole = (*state.scores(places), *shaped)
        fewer = (
            state.score(marginal, state.pruned(marginal, s.candidate))
            for s in whole
            if len(s.candidate.terms) > 1 and s.fit_gain > surplus + SWAP
        )
        options = sorted((*whole, *fewer), key=lambda s: -s.log_bayes_factor)
        form = now.candidate.form
        for option in options:
            other = option.candidate
            if (other.name, other.form) == (name, form):
                continue  # more places of the same are for `grow`, fewer for `prune`
            margin = 0.0 if other.name in state.names(places) else SWAP
            if option.log_bayes_factor - state.need(other.name, places) > surplus + margin:
                say(f"{other.label} instead of {name}")
                state.replace(places, option)
                changed = True
                break
    return changed


def split(state: SearchState, say: Callable[[str], None]) -> bool:
    """Let two effects take the place of one that does for both what neither does alone.

    A search that adds one effect at a time finds the compromise first.
    """
    for name in dict.fromkeys(name for name, _ in state.chosen):
        places, marginal, now = state.family(name)
        least = now.log_bayes_factor - state.threshold + SWAP
        forms: dict[str, list[Candidate]] = {}
        for option in state.scores(places):
            forms.setdefault(option.candidate.name, []).append(option.candidate)
        forms.pop(name, None)
        few = [form for options in list(forms.values())[:PAIRED] for form in options[:2]]
        both = [
            state.score(marginal, Candidate(f"{a.name} and {b.name}", (*a.terms, *b.terms)))
            for a, b in combinations(few, 2)
            if a.name != b.name
        ]
        best = max(both, key=lambda s: s.log_bayes_factor, default=None)
        if best is None:
            continue
        names = {t.name for t in best.candidate.terms}
        if best.log_bayes_factor - sum(state.need(n, places) for n in names) > least:
            say(f"{best.candidate.label} instead of {name}")
            state.replace(places, best)
            return True
    return False
