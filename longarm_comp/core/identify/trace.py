"""The search: which effects the data ask for, by evidence, with the geometry marginalised.

Forward by the largest Bayes factor, the geometry refitted jointly each time and never
frozen; outliers and noise are judged anew after every accepted effect, so that structure is
not thrown out as noise; then swaps, then a backward pass that drops what no longer pays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from longarm_comp.core.dataset import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.errors import JobError
from longarm_comp.core.identify import noise as noise_step
from longarm_comp.core.identify.candidates import Candidate, Columns, Term
from longarm_comp.core.identify.fit import Fit, fit, unfitted
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.noise import Noise
from longarm_comp.core.model import Model, Slot, slots_of

ODDS = math.log(20.0)
"""An effect must be this much (log) more probable than none after paying for the choice."""
LOCATED = 2.0
"""Within an effect, a place must be this much (log) more probable with it than without."""
MOST_TERMS = 12
ROUNDS = 4


@dataclass(frozen=True)
class Score:
    """One candidate against the model without it.

    Attributes:
        candidate: the hypothesis.
        log_bayes_factor: evidence gained, sign bounds counted.
        fit_gain: gain in penalised log likelihood.
        mean: (k,) parameter estimates (SI).
        sd: (k,) their posterior standard deviations.
        effect_m: RMS tip shift that it stands for, m.
    """

    candidate: Candidate
    log_bayes_factor: float
    fit_gain: float
    mean: np.ndarray
    sd: np.ndarray
    effect_m: float


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
    """

    fit: Fit
    base: Model
    chosen: tuple[Term, ...]
    noise: Noise
    first: tuple[Score, ...]
    last: tuple[Score, ...]
    threshold: float


def key(term: Term) -> tuple[str, str]:
    """An effect at a place: it can be there in one form only."""
    return term.name, term.place


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
    threshold = math.log(max(len(candidates), 1)) + ODDS
    state = _State(base, session, candidates, known_noise, {})
    say("geometry")
    state.refit()
    first = state.scores()
    for _ in range(ROUNDS):
        state.grow(threshold, say)
        if not (state.swap(say) | state.prune(threshold)):
            break
    return Traced(
        state.fit,
        base,
        tuple(state.chosen.values()),
        state.noise,
        first,
        state.scores(),
        threshold,
    )


class _State:
    """The model on its way: chosen terms, fit, noise and columns of every candidate."""

    def __init__(
        self,
        base: Model,
        session: Session,
        candidates: Sequence[Candidate],
        known: Noise | None,
        chosen: dict[tuple[str, str], Term],
    ) -> None:
        self.base, self.session, self.candidates = base, session, candidates
        self.known, self.chosen = known, chosen
        self._start = base
        self.refused: set[str] = set()

    def refit(self) -> None:
        """Judge the noise by all that the library could explain, then fit geometry and terms."""
        first = (
            unfitted(self._start, self.session) if self.chosen else fit(self._start, self.session)
        )
        every = self._columns_of(first).of(_distinct(self.candidates, self.chosen))
        judged, weights = noise_step.from_residual(first, every)
        if self.known is not None:
            judged = noise_step.agreed(self.known, judged)
        self.noise = judged
        self.fit = fit(
            first.model, self.session, sigma=judged.sigma, rho=judged.rho, weights=weights
        )
        self._start = self.fit.model
        self.columns = self._columns_of(self.fit)

    @staticmethod
    def _columns_of(fitted: Fit) -> Columns:
        rows = fitted.session
        q = [rows.q[:, j] for j in range(rows.n)]
        return Columns(fitted.model, fitted.model.posture(q, rows.context()))

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

    def best(self, threshold: float) -> Score | None:
        """The candidate to accept, if any pays for the choice."""
        names = {name for name, _ in self.chosen}
        for found in self.scores():
            if found.candidate.label in self.refused:
                continue
            need = threshold
            if found.candidate.name in names:
                siblings = sum(c.name == found.candidate.name for c in self.candidates)
                need = math.log(siblings) + ODDS
            if found.log_bayes_factor >= need and len(self.chosen) < 6 * MOST_TERMS:
                return found
        return None

    def grow(self, threshold: float, say: Callable[[str], None]) -> None:
        """Add effects until none pays; one that did not last is not tried again."""
        for _ in range(MOST_TERMS):
            best = self.best(threshold)
            if best is None:
                return
            say(best.candidate.label)
            before = dict(self.chosen), self._start, self.fit, self.columns, self.noise
            try:
                self.accept(best)
                self.prune(threshold)
            except JobError:
                self.chosen, self._start, self.fit, self.columns, self.noise = before
            if not any(key(t) in self.chosen for t in best.candidate.terms):
                self.refused.add(best.candidate.label)

    def accept(self, found: Score) -> None:
        """Add its terms, started at their estimates."""
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
        self._rebuild()

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

    def prune(self, threshold: float) -> bool:
        """Drop terms that the rest makes superfluous; whether anything went."""
        gone: list[tuple[str, str]] = []
        while len(gone) < len(self.chosen):
            worst, low = None, math.inf
            for place, term in self.chosen.items():
                if place in gone:
                    continue
                mates = sum(name == place[0] for name, _ in self.chosen if (name, _) not in gone)
                need = threshold if mates == 1 else self._located(term)
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
        """Exchange a family for a better one or a better form of it; whether any was."""
        changed = False
        for name in dict.fromkeys(name for name, _ in self.chosen):
            places = [c for c in self.chosen if c[0] == name]
            if not places:
                continue
            marginal = self.marginal(places)
            now = self.score(marginal, Candidate(name, tuple(self.chosen[p] for p in places)))
            options = [
                s
                for s in self.scores(places)
                if set(_keys(s.candidate)) != set(places)
                or s.candidate.form != Candidate(name, (self.chosen[places[0]],)).form
            ]
            if options and options[0].log_bayes_factor > now.log_bayes_factor + 1.0:
                say(f"{options[0].candidate.label} instead of {name}")
                for place in places:
                    del self.chosen[place]
                self.accept(options[0])
                changed = True
        return changed


def marginal_without(fitted: Fit, columns: Columns, places: set[tuple[str, str]]) -> Marginal:
    """Evidence on top of a fit, the terms at some places taken out of it.

    A term with parameters leaves with its columns; one without gives its shift back to the data.
    """
    kept = [k for k, s in enumerate(fitted.slots) if key(s.owner) not in places]
    data = fitted.data
    for term in fitted.model.terms:
        if key(term) in places and not slots_of(fitted.model.arm, [term]):
            data = data + fitted.whitened(columns.shift(term)[..., None])[:, 0]
    return Marginal(fitted.design[:, kept], data)


def score(fitted: Fit, marginal: Marginal, candidate: Candidate, columns: Columns) -> Score:
    """Evidence of a candidate on top of a marginal."""
    slots = candidate.slots(fitted.model.arm)
    if not slots:
        return _fixed(fitted, marginal, candidate, columns)
    scaled = columns.of(candidate.terms)
    white = fitted.whitened(scaled)
    if not np.isfinite(white).all() or not white.any():
        zero = np.zeros(len(slots))
        return Score(candidate, 0.0, 0.0, zero, zero, 0.0)
    added = marginal.added(white)
    sd = np.sqrt(np.diag(added.covariance))
    bounded = np.array([s.parameter.lower == 0.0 for s in slots])
    sided = (math.log(2.0) + norm.logcdf(added.mean / sd))[bounded].sum()
    mean = np.where(bounded, np.maximum(added.mean, 0.0), added.mean)
    scale = _prior(slots)
    return Score(
        candidate,
        added.log_bayes_factor + float(sided),
        added.fit_gain,
        mean * scale,
        sd * scale,
        _rms(scaled @ mean),
    )


def _fixed(fitted: Fit, marginal: Marginal, candidate: Candidate, columns: Columns) -> Score:
    """An effect without parameters: it is there, whole, or it is not."""
    shift = np.sum([columns.shift(term) for term in candidate.terms], axis=0)
    white = fitted.whitened(shift[..., None])[:, 0]
    projected = marginal.project(white)
    gain = float(projected @ marginal.y - 0.5 * projected @ white)
    empty = np.zeros(0)
    return Score(candidate, gain, gain, empty, empty, _rms(shift))


def _rms(shift: np.ndarray) -> float:
    return float(np.sqrt((shift**2).sum(-1).mean()))


def _prior(slots: Sequence[Slot]) -> np.ndarray:
    return np.array([s.parameter.prior for s in slots])


def _keys(candidate: Candidate) -> list[tuple[str, str]]:
    return [key(t) for t in candidate.terms]


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
