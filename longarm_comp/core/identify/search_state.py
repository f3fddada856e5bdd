"""The state of a search: the chosen terms, their fit, the noise, every candidate's columns."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.errors import JobError
from longarm_comp.core.identify import noise as noise_step
from longarm_comp.core.identify.candidates import Candidate, Term, distinct
from longarm_comp.core.identify.evidence import (
    LOCATED,
    FitColumns,
    FitMarginal,
    Score,
    columns_at,
    key,
    marginal_without,
    pruned,
    refined,
    score,
    scores,
)
from longarm_comp.core.identify.fit import fit, unfitted
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import NoiseEstimate
from longarm_comp.core.identify.step_scan import UnknownStep, scan
from longarm_comp.core.identify.thresholds import retuned, undecided
from longarm_comp.core.model.model import Model, slots_of

ODDS = math.log(20.0)
"""An effect must be this much (log) more probable than none after paying for the choice."""
REFINEMENTS = 4
"""Times that a term is refined at most, each with the rest as it has become."""
MOST_ACCEPTED = 10
"""Effects that are tried on in all; a residual that asks for more is none of the library's."""
STEPS = 6
"""Iterations of an intermediate fit; only the final fit converges."""
NEAR = 0.3
"""Its last step, in standard errors: the next would be a tenth of it or less."""
MOST_TERMS = 72


class SearchState:
    """The model while it grows: chosen terms, fit, noise and columns of every candidate."""

    def __init__(
        self,
        base: Model,
        session: Session,
        candidates: Sequence[Candidate],
        known: NoiseEstimate | None,
        stepped: Sequence[type[Effect]] = (),
    ) -> None:
        self.base, self.session, self.candidates = base, session, candidates
        self.known = known
        self.chosen: dict[tuple[str, str], Term] = {}
        self.threshold = math.log(max(len(candidates), 1)) + ODDS
        self._start = base
        self.fit: ModelFit
        self._sure: ModelFit | None = None
        self.stepped = stepped
        self.unknown_steps: dict[str, UnknownStep] = {}
        self.refused: set[str] = set()
        self.accepted = 0
        self.refinements: Counter[tuple[str, str]] = Counter()

    def refit(self) -> None:
        """Judge the noise by all that the library could explain, then fit geometry and terms.

        The library's columns at the last fit will do for the noise.
        """
        first = (
            unfitted(self._start, self.session, self.fit)
            if self.chosen
            else fit(self._start, self.session)
        )
        at: FitColumns = self.columns if self.chosen else columns_at(first)
        every = at.of(distinct(self.candidates, self.chosen))
        judged, weights = noise_step.from_residual(first, every)
        if self.known is not None:
            judged = noise_step.agreed(self.known, judged)
        self.noise = judged
        self.fit = fit(
            first.model, self.session, sigma=judged.sigma, rho=judged.rho, weights=weights,
            max_iterations=STEPS, close=NEAR, begun=first,
        )  # fmt: skip
        self._start = self.fit.model
        self._look()

    def _look(self) -> None:
        """Columns of every candidate at the fit."""
        self.columns: FitColumns = columns_at(self.fit)
        self.columns.prepare(distinct(self.candidates, self.chosen))
        switched = [t for t in self.fit.model.terms if key(t) in self.chosen and t.scales()]
        rows = undecided(self.fit, self.columns, switched) & (self.fit.weights > 0)
        weights = np.where(rows, 0.0, self.fit.weights)
        self._sure = dataclasses.replace(self.fit, weights=weights) if rows.any() else None

    def settle(self) -> None:
        """Take the last fit to its end."""
        was = self.fit
        self.fit = fit(
            was.model, self.session, sigma=was.sigma, rho=was.rho, weights=was.weights, begun=was
        )
        self._look()

    def marginal(self, without: Sequence[tuple[str, str]] = ()) -> FitMarginal:
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
                made.append(Candidate(candidate.name, new))
        return tuple(
            sorted(
                scores(self.fit, marginal, made, self.columns), key=lambda s: -s.log_bayes_factor
            )
        )

    def score(self, marginal: FitMarginal, candidate: Candidate) -> Score:
        """One candidate on top of a marginal."""
        return score(self.fit, marginal, candidate, self.columns)

    def pruned(self, marginal: FitMarginal, candidate: Candidate) -> Candidate:
        """A family without the places that bring nothing on top of a marginal."""
        return pruned(self.fit, marginal, candidate, self.columns)

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
            need = self.need(found.candidate.name)
            enough = found.log_bayes_factor >= need and len(self.chosen) < MOST_TERMS
            if enough and self._decided(found.candidate, need):
                return found
        return None

    def _decided(self, candidate: Candidate, need: float) -> bool:
        """Whether it pays too without the rows that thresholds of chosen terms do not decide.

        Whatever changes the loads a little can put such a row on its right side.
        """
        if self._sure is None or any(term.scales() for term in candidate.terms):
            return True
        columns, marginal = columns_at(self._sure), FitMarginal(self._sure)
        return score(self._sure, marginal, candidate, columns).log_bayes_factor >= need

    def scan_steps(self) -> bool:
        """Take the steps that the residual shows among the candidates; whether there are any."""
        scans = [scan(self.fit, self.columns, kind, self.threshold) for kind in self.stepped]
        found = [candidate for each in scans for candidate in each.found]
        self.candidates = [*(c for c in self.candidates if not c.scanned), *found]
        self.unknown_steps |= {each.where: each for made in scans for each in made.unknown}
        return bool(found)

    def grow(self, say: Callable[[str], None]) -> None:
        """Add effects until none pays; one that did not last is not tried again."""
        while not self.exhausted:
            best = self.best()
            if best is None:
                return
            self.accepted += 1
            say(best.candidate.label)
            before = dict(self.chosen), self._start, self.fit, self.columns, self.noise, self._sure
            try:
                self.accept(best)
                while self.refine_forms(say):
                    pass
                self.prune()
            except JobError:
                (self.chosen, self._start, self.fit, self.columns, self.noise, self._sure) = before
            if not any(key(t) in self.chosen for t in best.candidate.terms):
                self.refused.add(best.candidate.label)

    def accept(self, found: Score) -> None:
        """Add its terms, started at their estimates, and fit."""
        self._put(found)
        self._rebuild()

    def replace(self, places: Sequence[tuple[str, str]], found: Score) -> None:
        """Accept it in the place of what is chosen at some places."""
        for place in places:
            del self.chosen[place]
        self.accept(found)

    def family(self, name: str) -> tuple[list[tuple[str, str]], FitMarginal, Score]:
        """Where an effect is chosen, the model without it, and its evidence there."""
        places = [place for place in self.chosen if place[0] == name]
        marginal = self.marginal(places)
        terms = tuple(self.chosen[place] for place in places)
        return places, marginal, self.score(marginal, Candidate(name, terms))

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
        known = {t.variant: t for t in self._start.terms}
        geometry = [t for t in self._start.terms if key(t) in {key(b) for b in self.base.terms}]
        kept = [known.get(t.variant, t) for t in self.chosen.values()]
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

    def refine_forms(self, say: Callable[[str], None]) -> bool:
        """Move forms that lie on a scale to where the evidence is highest; whether any moved."""
        better: list[Score] = []
        for place, term in self.chosen.items():
            if term.scales() and self.refinements[place] < REFINEMENTS:
                best = self.best_form(term, [place])
                self.refinements[place] += 1
                if best.candidate.terms != (term,):
                    better.append(best)
        for best in better:
            say(best.candidate.label)
            self._put(best)
        if better:
            self._rebuild()
        return bool(better)

    def retune(self, say: Callable[[str], None]) -> bool:
        """Move thresholds to where most rows agree, outliers too; whether any moved."""
        moved = False
        for place, term in self.chosen.items():
            fitted = next(t for t in self.fit.model.terms if key(t) == place)
            better = retuned(self.fit, self.columns, fitted)
            if better is not fitted:
                self.chosen[place] = better
                say(Candidate(term.name, (better,)).label)
                moved = True
        if moved:
            self._rebuild()
        return moved

    def best_form(self, term: Term, without: Sequence[tuple[str, str]]) -> Score:
        marginal = self.marginal(without)
        return refined(self.fit, marginal, self.columns, term, self.candidates)

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

    def names(self, without: Sequence[tuple[str, str]]) -> set[str]:
        return {name for name, _ in self.chosen if (name, _) not in without}
