"""The search: which effects the data ask for, by evidence, with the geometry marginalised.

Forward by the largest Bayes factor, the geometry refitted jointly each time and never
frozen; outliers and noise are judged anew after every accepted effect, so that structure is
not thrown out as noise; then forms are sharpened, two effects at one place that one effect
explains are merged, families swapped, and a backward pass drops what no longer pays.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.dataset import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.errors import JobError
from longarm_comp.core.identify import noise as noise_step
from longarm_comp.core.identify.candidates import Candidate, Term
from longarm_comp.core.identify.evidence import Score, columns_at, key, marginal_without, score
from longarm_comp.core.identify.fit import Fit, fit, unfitted
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.noise import Noise
from longarm_comp.core.identify.sharpen import reshaped, sharpened
from longarm_comp.core.model import Model, slots_of

ODDS = math.log(20.0)
"""An effect must be this much (log) more probable than none after paying for the choice."""
LOCATED = 2.0
"""Within an effect, a place must be this much (log) more probable with it than without."""
SWAP = 1.0
"""A new name must be this much (log) more probable than the one it replaces."""
COARSE = 50.0
"""A form this much (log) worse than the best may still win once its scale is sharpened."""
SHARPENED = 4
"""Times that a term is sharpened at most, each with the rest as it has become."""
MOST_ACCEPTED = 10
"""Effects that are tried on in all; a residual that asks for more is none of the library's."""
STEPS = 6
"""Of every fit on the way; the next one goes on from there, and the last one to the end."""
MOST_TERMS = 72
ROUNDS = 4


@dataclass(frozen=True)
class Traced:
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
) -> Traced:
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
    state = _State(base, session, candidates, known_noise)
    say("geometry")
    state.refit()
    first = state.scores()
    for _ in range(ROUNDS):
        state.grow(say)
        if state.exhausted:
            state.prune()
            break
        if not (state.sharpen(say) | state.merge(say) | state.swap(say) | state.prune()):
            break
    state.settle()
    return Traced(
        state.fit,
        base,
        tuple(state.chosen.values()),
        state.noise,
        first,
        state.scores(),
        state.threshold,
        state.exhausted,
    )


def dropped(traced: Traced, places: set[tuple[str, str]]) -> Traced:
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


class _State:
    """The model on its way: chosen terms, fit, noise and columns of every candidate."""

    def __init__(
        self,
        base: Model,
        session: Session,
        candidates: Sequence[Candidate],
        known: Noise | None,
    ) -> None:
        self.base, self.session, self.candidates = base, session, candidates
        self.known = known
        self.chosen: dict[tuple[str, str], Term] = {}
        self.threshold = math.log(max(len(candidates), 1)) + ODDS
        self._start = base
        self.refused: set[str] = set()
        self.accepted = 0
        self.sharp: Counter[tuple[str, str]] = Counter()

    def refit(self) -> None:
        """Judge the noise by all that the library could explain, then fit geometry and terms."""
        first = (
            unfitted(self._start, self.session) if self.chosen else fit(self._start, self.session)
        )
        every = columns_at(first).of(_distinct(self.candidates, self.chosen))
        judged, weights = noise_step.from_residual(first, every)
        if self.known is not None:
            judged = noise_step.agreed(self.known, judged)
        self.noise = judged
        self.fit = fit(
            first.model, self.session, sigma=judged.sigma, rho=judged.rho, weights=weights,
            max_iterations=STEPS,
        )  # fmt: skip
        self._start = self.fit.model
        self.columns = columns_at(self.fit)
        self.columns.of(_distinct(self.candidates, self.chosen))  # all at once: much faster

    def settle(self) -> None:
        """Take the last fit to its end."""
        was = self.fit
        if not was.converged:
            self.fit = fit(
                was.model, self.session, sigma=was.sigma, rho=was.rho, weights=was.weights
            )
            self.columns = columns_at(self.fit)

    def marginal(self, without: Sequence[tuple[str, str]] = ()) -> Marginal:
        """Evidence on top of all but some chosen terms."""
        return marginal_without(self.fit, self.columns, set(without))

    def scores(self, without: Sequence[tuple[str, str]] = ()) -> tuple[Score, ...]:
        """Every candidate that is not in the model already, best first."""
        marginal = self.marginal(without)
        held = {k: t for k, t in self.chosen.items() if k not in without}
        made = []
        for candidate in self.candidates:
            new = tuple(t for t in candidate.terms if key(t) not in held)
            if len(new) > 1 or new == candidate.terms:
                made.append(self.score(marginal, Candidate(candidate.name, new)))
        return tuple(sorted(made, key=lambda s: -s.log_bayes_factor))

    def score(self, marginal: Marginal, candidate: Candidate) -> Score:
        """One candidate on top of a marginal."""
        return score(self.fit, marginal, candidate, self.columns)

    def need(self, name: str, without: Sequence[tuple[str, str]] = ()) -> float:
        """Evidence that pays for the choice: among all, or among the forms of a known effect."""
        if any(k[0] == name for k in self.chosen if k not in without):
            return math.log(sum(c.name == name for c in self.candidates)) + ODDS
        return self.threshold

    @property
    def exhausted(self) -> bool:
        """Whether no more may be added."""
        return self.accepted >= MOST_ACCEPTED

    def best(self) -> Score | None:
        """The candidate to accept, if any pays for the choice."""
        for found in self.scores():
            if found.candidate.label in self.refused:
                continue
            enough = found.log_bayes_factor >= self.need(found.candidate.name)
            if enough and len(self.chosen) < MOST_TERMS:
                return found
        return None

    def grow(self, say: Callable[[str], None]) -> None:
        """Add effects until none pays; one that did not last is not tried again."""
        while not self.exhausted:
            best = self.best()
            if best is None:
                return
            self.accepted += 1
            say(best.candidate.label)
            before = dict(self.chosen), self._start, self.fit, self.columns, self.noise
            try:
                self.accept(best)
                while self.sharpen(say):
                    pass
                self.prune()
            except JobError:
                self.chosen, self._start, self.fit, self.columns, self.noise = before
            if not any(key(t) in self.chosen for t in best.candidate.terms):
                self.refused.add(best.candidate.label)

    def accept(self, found: Score) -> None:
        """Add its terms, started at their estimates, and fit."""
        self._put(found)
        self._rebuild()

    def _put(self, found: Score) -> None:
        start = 0
        for term in found.candidate.terms:
            slots = slots_of(self.base.arm, [term])
            values = {
                s.parameter.name: float(
                    np.clip(found.mean[start + k], s.parameter.lower, s.parameter.upper)
                )
                for k, s in enumerate(slots)
            }
            start += len(slots)
            self.chosen[key(term)] = term.with_values(values)

    def _rebuild(self) -> None:
        known = {(key(t), repr(t.placement)): t for t in self._start.terms}
        geometry = [t for t in self._start.terms if key(t) in {key(b) for b in self.base.terms}]
        kept = [known.get((k, repr(t.placement)), t) for k, t in self.chosen.items()]
        effects = [t for t in (*geometry, *kept) if isinstance(t, Effect)]
        biases = [t for t in (*geometry, *kept) if isinstance(t, Bias)]
        self._start = Model(
            self.base.arm,
            tuple(effects),
            tuple(biases),
            self.base.passes,
            self.base.elements_per_beam,
        )
        self.refit()

    def sharpen(self, say: Callable[[str], None]) -> bool:
        """Move forms that lie on a scale to where the evidence is highest; whether any moved."""
        better: list[Score] = []
        for place, term in self.chosen.items():
            if term.tunable and self.sharp[place] < SHARPENED:
                best = self._sharpened(term, [place])
                self.sharp[place] += 1
                if best.candidate.terms != (term,):
                    better.append(best)
        for best in better:
            say(best.candidate.label)
            self._put(best)
        if better:
            self._rebuild()
        return bool(better)

    def _sharpened(self, term: Term, without: Sequence[tuple[str, str]]) -> Score:
        marginal = self.marginal(without)
        return sharpened(self.fit, marginal, self.columns, term, self.candidates)

    def merge(self, say: Callable[[str], None]) -> bool:
        """Where two effects sit at one place, let one of them do, in another form if need be."""
        merged = False
        for where in dict.fromkeys(t.where for t in self.chosen.values()):
            places = [k for k, t in self.chosen.items() if t.where == where]
            if len(places) < 2:
                continue
            now = self.score(
                self.marginal(places), Candidate("", tuple(self.chosen[p] for p in places))
            )
            names = {name for name, _ in places}
            first: dict[str, Score] = {}
            for single in self.scores(places):
                close = single.log_bayes_factor > now.log_bayes_factor - COARSE
                if close and single.candidate.name in names and single.candidate.where == (where,):
                    first.setdefault(single.candidate.name, single)
            options = [self._sharpened(s.candidate.terms[0], places) for s in first.values()]
            best = max(options, key=lambda s: s.log_bayes_factor, default=None)
            if best is not None and best.log_bayes_factor >= now.log_bayes_factor:
                say(f"{best.candidate.label} alone")
                for place in places:
                    del self.chosen[place]
                self.accept(best)
                merged = True
        return merged

    def prune(self) -> bool:
        """Drop terms that the rest makes superfluous; whether anything went."""
        gone: list[tuple[str, str]] = []
        while len(gone) < len(self.chosen):
            worst, low = None, math.inf
            for place, term in self.chosen.items():
                if place in gone:
                    continue
                mates = sum(name == place[0] for name, _ in self.chosen if (name, _) not in gone)
                need = self.threshold if mates == 1 else self._located(term)
                single = Candidate(term.name, (term,))
                gain = self.score(self.marginal([*gone, place]), single).log_bayes_factor - need
                if gain < low:
                    worst, low = place, gain
            if worst is None or low >= 0:
                break
            gone.append(worst)
        for place in gone:
            del self.chosen[place]
        if gone:
            self._rebuild()
        return bool(gone)

    def _located(self, term: Term) -> float:
        """What a place must gain to stay; with nothing to fit, it must only not contradict."""
        return LOCATED if slots_of(self.base.arm, [term]) else -1.0

    def swap(self, say: Callable[[str], None]) -> bool:
        """Exchange a family for a better one, a better form, or more of what is there anyhow."""
        changed = False
        for name in dict.fromkeys(name for name, _ in self.chosen):
            places = [c for c in self.chosen if c[0] == name]
            if not places:
                continue
            terms = tuple(self.chosen[p] for p in places)
            marginal = self.marginal(places)
            now = self.score(marginal, Candidate(name, terms))
            shaped = [self.score(marginal, c) for c in reshaped(terms, self.candidates)]
            options = sorted((*self.scores(places), *shaped), key=lambda s: -s.log_bayes_factor)
            form = Candidate(name, terms).form
            surplus = now.log_bayes_factor - self.threshold
            for option in options:
                other = option.candidate
                if (other.name, other.form) == (name, form):
                    continue  # more places of the same are for `grow`, fewer for `prune`
                margin = 0.0 if other.name in self._names(places) else SWAP
                if option.log_bayes_factor - self.need(other.name, places) > surplus + margin:
                    say(f"{other.label} instead of {name}")
                    for place in places:
                        del self.chosen[place]
                    self.accept(option)
                    changed = True
                    break
        return changed

    def _names(self, without: Sequence[tuple[str, str]]) -> set[str]:
        return {name for name, _ in self.chosen if (name, _) not in without}


def _distinct(
    candidates: Sequence[Candidate], chosen: dict[tuple[str, str], Term]
) -> tuple[Term, ...]:
    """Each instance once, those already in the model left out."""
    made: dict[tuple[object, ...], Term] = {}
    for candidate in candidates:
        for term in candidate.terms:
            if key(term) not in chosen:
                made.setdefault((*key(term), repr(term.placement)), term)
    return tuple(made.values())
