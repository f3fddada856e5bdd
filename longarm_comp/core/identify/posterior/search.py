"""The search for the best explanation: from one explanation to the next better one.

Each round linearises the session's equations at the present model, offers every effect of the
library and functions without a name (`offers.py`), computes the posterior over them (`ascent.py`),
puts the most probable explanation into the model, and fits that.  Noise and outliers are judged
again, and the scales of forms move to where the evidence is highest.  The search ends when no
explanation is better.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from longarm_comp.core.calibration.candidates import Candidate, distinct_terms
from longarm_comp.core.calibration.fit import fit_model, linearise_model
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import BETTER
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.noise import (
    NoiseEstimate,
    limit_by_repeats,
    noise_from_residual,
)
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.errors import JobError
from longarm_comp.core.identify.model_tolerance import FORMS, TOLERANCES, ModelTolerance
from longarm_comp.core.identify.posterior.explained import NEAR, ExplainedSession, widen_prior
from longarm_comp.core.identify.posterior.forms import find_better_forms, measure_agreement
from longarm_comp.core.identify.posterior.found import (
    NONE,
    FoundEffect,
    ProposedFunction,
    keys_of,
)
from longarm_comp.core.identify.posterior.offer import ROUNDS
from longarm_comp.core.identify.posterior.offered_effects import (
    IMPOSSIBLE,
    OfferedEffects,
    PosteriorResult,
)
from longarm_comp.core.identify.posterior.offers import make_offers
from longarm_comp.core.identify.posterior.proposed_functions import propose_functions
from longarm_comp.core.identify.step_scan import scan_steps
from longarm_comp.core.model.model import Model


@dataclass
class ExplanationSearch:
    """A search for the best explanation, from one to the next better one.

    An explanation is the set of effects that are in the model besides the geometry.

    Attributes:
        base: the declared model with its geometry terms, to which found effects are added.
        session: the rows that are explained.
        candidates: the library, and the servo steps that the residual shows now.
        known: the noise by repeats; None if there are too few.
        stepped: effect classes whose steps are scanned (`step_scan.py`).
        say: called with the name of each effect found.
        functions: functions without a name that are on offer.
        nameless: whether an arm with only soft parts (`ModelTolerance.is_soft`) is tried.
        scanned: the fit whose servo steps are among the candidates.
    """

    base: Model
    session: Session
    candidates: list[Candidate]
    known: NoiseEstimate | None
    stepped: Sequence[type[Effect]]
    say: Callable[[str], None]
    functions: tuple[ProposedFunction, ...] = ()
    nameless: bool = False
    scanned: ModelFit | None = None

    def repeat_until_best(
        self, state: ExplainedSession, functions: bool = False
    ) -> ExplainedSession:
        """Explain and fit in turn, as long as the explanation gets better.

        Args:
            state: the explained session to begin with.
            functions: whether functions without a name are proposed anew in each round.

        Returns:
            The best explained session: `state` itself if none is better.
        """
        for _ in range(ROUNDS):
            # The servo steps on offer are those that the residual shows now
            if state.fit is not self.scanned:
                need = NONE + math.log(max(len(self.candidates), 1))
                steps = [c for kind in self.stepped for c in scan_steps(state.fit, kind, need)]
                self.candidates = [*(c for c in self.candidates if not c.scanned), *steps]
                self.scanned = state.fit
            if functions:
                tolerance = self.weigh_tolerances(state.fit, state.found)[1]
                self.functions = propose_functions(
                    state.fit, state.found, self.candidates, tolerance
                )
            explained = self._explain_better(state)
            if explained is None:
                break
            for f in explained.found:
                self.say(Candidate(f.name, f.terms).label)
            taken = self.fit_with(state, tuple(map(widen_prior, explained.found)))
            if taken is None:
                break
            taken = self._move_forms(taken)
            if not self._is_better(state, taken):
                break
            state = taken
        return state

    def fit_geometry(self) -> ExplainedSession:
        """Fit the base model alone.

        Raises:
            InputError, JobError: as `fit_model`.
        """
        first = fit_model(self.base, self.session)
        return self._fit_with_noise(first, first, ())

    def fit_with(
        self, state: ExplainedSession, found: tuple[FoundEffect, ...]
    ) -> ExplainedSession | None:
        """Fit the base model with other effects than those of a state.

        Args:
            state: gives the values to begin with, and the columns by which noise is judged.
            found: the effects to fit.

        Returns:
            The explained session; None if the fit diverges.
        """
        model = self._put_found(state.fit.model, found)
        try:
            if not found:
                first = fit_model(model, self.session)
                return self._fit_with_noise(first, first, found)
            first = linearise_model(model, self.session, state.fit)
            return self._fit_with_noise(first, state.fit, found)
        except JobError:
            return None

    def _fit_with_noise(
        self, begun: ModelFit, at: ModelFit, found: tuple[FoundEffect, ...]
    ) -> ExplainedSession:
        """Fit again, with the noise that is left if the library explains as much as it can.

        The columns of the library are those at the fit `at`.
        """
        library = distinct_terms(self.candidates, keys_of(found))
        noise, weights = noise_from_residual(begun, FitColumns(at).prior_columns(library))
        if self.known is not None:
            noise = limit_by_repeats(self.known, noise)
        judged: dict[str, Any] = {"sigma": noise.sigma, "rho": noise.rho, "weights": weights}
        fitted = fit_model(begun.model, self.session, close=NEAR, begun=begun, **judged)
        return ExplainedSession(fitted, found, noise)

    def _put_found(self, now: Model, found: Sequence[FoundEffect]) -> Model:
        """Return the base model with found effects added; values are those in the model `now`."""
        known, alike = {t.key: t for t in now.terms}, {t.variant: t for t in now.terms}
        terms = (alike.get(t.variant, t) for f in found for t in f.terms)
        return self.base.with_terms([*(known.get(t.key, t) for t in self.base.terms), *terms])

    def compare_odds(self, one: ExplainedSession, other: ExplainedSession) -> float:
        """Return the log odds of `other` against `one`.

        They are computed with the noise of each of the two, and averaged.
        """
        made = []
        for judged in (one.fit.noise_arguments, other.fit.noise_arguments):
            mine, theirs = (
                self.evidence_of_all(
                    fit_model(e.fit.model, self.session, close=NEAR, **judged), e.found
                )
                for e in (one, other)
            )
            made.append(theirs - mine)
        return sum(made) / len(made)

    def weigh_tolerances(
        self, fitted: ModelFit, found: Sequence[FoundEffect]
    ) -> tuple[float, ModelTolerance]:
        """Return the highest log evidence of an explanation, and the tolerance that gives it.

        Effects and places that do not raise the evidence, priors included, are dropped first.
        """
        every = self.offer_by_tolerance(fitted, found, others=False)
        return max((bank.evidence_pruned, bank.tolerance) for bank in every)

    def evidence_of_all(
        self, fitted: ModelFit, found: Sequence[FoundEffect], **near: ModelFit
    ) -> float:
        """Return the log evidence of an explanation with all effects, at its best tolerance.

        None is dropped, because the columns, which are linearised, tell little about the arm
        without a large effect.
        """
        every = self.offer_by_tolerance(fitted, found, others=False, **near)
        return max(bank.evidence_of_known for bank in every)

    def evidence_refitted(
        self, state: ExplainedSession, found: tuple[FoundEffect, ...], best_places: bool = False
    ) -> float:
        """Return the log evidence of other effects than a state's, fitted with the same noise.

        It is -inf if one effect occurs twice at a place, or if the fit fails.

        Args:
            state: gives the noise and the values to begin with.
            found: the effects to fit.
            best_places: whether effects and places that do not raise the evidence are dropped.
        """
        places = [t.key for f in found for t in f.terms]
        if len(set(places)) < len(places):
            return -math.inf
        try:
            model = self._put_found(state.fit.model, found)
            begun = fit_model(
                model, self.session, close=NEAR, near=state.fit, **state.fit.noise_arguments
            )
        except JobError:
            return -math.inf
        if best_places:
            return self.weigh_tolerances(begun, found)[0]
        return self.evidence_of_all(begun, found, near=state.fit)

    def offer_by_tolerance(
        self,
        fitted: ModelFit,
        found: Sequence[FoundEffect],
        others: bool = True,
        near: ModelFit | None = None,
    ) -> list[OfferedEffects]:
        """Make the offers at a fit, one bank for each model tolerance that applies.

        Tolerances with another error of forms than the first are tried only if something was found.
        The arguments are those of `make_offers`.
        """
        tried = [
            tolerance
            for tolerance in TOLERANCES
            if (found or tolerance.form == FORMS[0]) and (self.nameless or not tolerance.is_soft)
        ]
        return make_offers(
            fitted, self.candidates, self.functions, found, tried, others=others, near=near
        )

    def _explain_better(self, state: ExplainedSession) -> PosteriorResult | None:
        """Return the best explanation at any tolerance, or None if the present one is as good.

        The likeliest tolerance is tried first.  A tolerance is not tried if the best explanation so
        far is practically impossible at it (`IMPOSSIBLE`).
        """
        left = self.offer_by_tolerance(state.fit, state.found)
        first = max(left, key=lambda bank: bank.evidence_of_known)
        left.remove(first)
        best = first.find_best()
        while left:
            likeliest = max(left, key=lambda bank: bank.evidence_of(best))
            if likeliest.evidence_of(best) < best.evidence + math.log(IMPOSSIBLE):
                break
            left.remove(likeliest)
            best = max(best, likeliest.find_best(best.effects), key=lambda e: e.evidence)
        return best if best.evidence >= first.evidence_of_known + BETTER else None

    def _is_better(self, before: ExplainedSession, now: ExplainedSession) -> bool:
        """Tell whether the fitted explanation `now` is better than the one before.

        The columns are linearised. If two effects need each other, as a load needs a part that
        yields, one alone seems to explain what only both can.  So each explanation counts with all
        of its effects, even if some do not raise the evidence. Otherwise an explanation could not
        replace the same one with more effects.
        """
        was = before.fit
        again = fit_model(was.model, self.session, close=NEAR, begun=was, **now.fit.noise_arguments)
        least = self.evidence_of_all(again, before.found, near=now.fit) + BETTER
        return self.evidence_of_all(now.fit, now.found) > least

    def _move_forms(self, state: ExplainedSession) -> ExplainedSession:
        """Move the scales of forms to where the evidence is highest, while more rows agree.

        A form that does not move is not tried again.
        """
        terms = [t for f in state.found for t in f.terms]
        while moved := find_better_forms(state.fit, terms, self.candidates):
            terms = list(moved.values())
            for term in moved.values():
                self.say(Candidate(term.name, (term,)).label)
            found = tuple(f.with_terms(moved.get(t.key, t) for t in f.terms) for f in state.found)
            taken = self.fit_with(state, found)
            before = measure_agreement(state.fit, state.fit.residual)
            if taken is None or measure_agreement(state.fit, taken.fit.residual) < before + BETTER:
                break
            state = taken
        return state
