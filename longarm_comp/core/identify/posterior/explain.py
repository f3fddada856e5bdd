"""The search for what the model lacks: a posterior over explanations, and the model refitted.

Each round linearises the session's equations at the present model, offers every effect of the
library and functions without a name (`offers.py`), computes the posterior over them (`ascent.py`),
puts the most probable explanation into the model, and fits that.  Noise and outliers are judged
again, and forms on a scale move to where the evidence is highest.  The search ends when the
explanation repeats.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit import fit
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.noise import NoiseEstimate
from longarm_comp.core.data.holdout import split_in_half
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.errors import JobError
from longarm_comp.core.identify.model_tolerance import (
    FORMS,
    TOLERANCES,
    ModelTolerance,
    with_background,
)
from longarm_comp.core.identify.posterior.ascent import BETTER
from longarm_comp.core.identify.posterior.explained import (
    NEAR,
    ExplainedSession,
    judge_noise_and_fit,
    loosen,
    put_in,
    without_idle,
)
from longarm_comp.core.identify.posterior.forms import agreement, better_forms
from longarm_comp.core.identify.posterior.found import (
    CREDIBLE,
    NONE,
    FoundEffect,
    ProposedFunction,
    instead,
)
from longarm_comp.core.identify.posterior.offered_effects import (
    IMPOSSIBLE,
    Explained,
    OfferedEffects,
)
from longarm_comp.core.identify.posterior.offers import make_offers
from longarm_comp.core.identify.posterior.proposed_functions import propose_functions
from longarm_comp.core.identify.posterior.resampled import SAMPLES, Resampling
from longarm_comp.core.identify.step_scan import scan
from longarm_comp.core.model.model import Model

ROUNDS = 8
"""Most rounds of posterior and fit, of one kind, and of forms within one; three are usual."""


def explain_session(
    base: Model,
    session: Session,
    candidates: Sequence[Candidate],
    *,
    known_noise: NoiseEstimate | None = None,
    stepped: Sequence[type[Effect]] = (),
    functions: bool = True,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> ExplainedSession:
    """Find what the model lacks.

    Args:
        base: the declared model with its geometry terms.
        session: training rows.
        candidates: the library.
        known_noise: the noise from repeats; without it, it is judged from the residual.
        stepped: effects whose steps are scanned.
        functions: whether functions without a name are offered.
        seed: seed of the samples of the rows over which the probabilities are averaged.
        progress: called with the name of each step.

    Raises:
        InputError, JobError: as `fit`.
    """
    say = progress or (lambda _: None)
    return _Search(base, session, list(candidates), known_noise, stepped, say).run(functions, seed)


@dataclass
class _Search:
    """A search, which goes from explanation to explanation, each better than the one before."""

    base: Model
    session: Session
    candidates: list[Candidate]
    known: NoiseEstimate | None
    stepped: Sequence[type[Effect]]
    say: Callable[[str], None]
    functions: tuple[ProposedFunction, ...] = ()
    nameless: bool = False
    of_halves: tuple[tuple[FoundEffect, ...], ...] = ()

    def run(self, functions: bool, seed: int) -> ExplainedSession:
        self.say("geometry")
        state = judge_noise_and_fit(self.base, self.session, self.candidates, known=self.known)
        weighed = not any(t.through_others for t in self.base.terms)
        state = self._repeat(state) if weighed else self._start_soft(state)
        if functions:  # only beside the best of what has a name
            state, _, changed = self._compare_rivals(state)
            state = self._repeat(state) if changed else state
            self.nameless = True
            state = self._by_halves(self._repeat(self._repeat(state), functions=True), seed)
        state, doubtful, changed = self._compare_rivals(state)
        if changed:
            state = self._repeat(state)
            state, again, _ = self._compare_rivals(state)
            taken = {t.key for f in (*state.found, *again) for t in f.terms}
            left = (f for f in doubtful if taken.isdisjoint(t.key for t in f.terms))
            doubtful = (*again, *left)
        state, absence = self._held_against_absence(state)
        tolerance = self._standing(state.fit, state.found)[1]
        self.say("resampled rows")
        linear = Resampling(
            state.fit, self.candidates, self.functions, state.found, tolerance, self.of_halves
        )
        found = tuple(
            f.with_doubt(*absence[f.name]) if f.name in absence else f
            for f in linear.average_samples(seed)
        )
        least = 0.5 * SAMPLES / (SAMPLES + len(self.of_halves))  # a half may have too few rows
        stable = tuple(f for f in found if f.there > least)
        fewer = self._fit_with(state, stable) if len(stable) < len(found) else None
        if fewer is not None:
            doubtful = (*doubtful, *(f for f in found if f.there <= least))
            linear, state = replace(linear, fit=fewer.fit, found=fewer.found), fewer
        else:
            state = replace(state, found=found)
        rest = self._rest(state)
        closed = fit(state.fit.model, self.session, begun=state.fit, **state.fit.judged)
        fitted = without_idle(with_background(closed, self.candidates, rest) if rest else closed)
        known = {t.variant: t for t in fitted.model.terms}
        held = (replace(f, terms=tuple(known[t.variant] for t in f.terms)) for f in state.found)
        left = (f for f in doubtful if f.in_doubt)
        return ExplainedSession(
            fitted, tuple(held), state.noise, tuple(left), tuple(self.candidates), tolerance, linear
        )

    def _start_soft(self, state: ExplainedSession) -> ExplainedSession:
        """Search also from an elastic effect at all its places, where some of them are better.

        Only a fit moves the weights of an arm that declares none.  At those of another effect the
        columns show the wrong part, and without any there is no column.
        """
        best = self._repeat(state)
        for c in self.candidates:
            if len(c.terms) > 1 and c.terms[0].elastic:
                every = (FoundEffect(c.terms, 1.0, 0.0),)
                here, there = (self._best_places(best, found) for found in (best.found, every))
                if there > here + BETTER and (begun := self._fit_with(best, every)) is not None:
                    taken = self._repeat(begun)
                    best = taken if self._odds(best, taken) > BETTER else best
        return best

    def _best_places(self, state: ExplainedSession, found: tuple[FoundEffect, ...]) -> float:
        """Return the log evidence of the best places of some effects, fitted with a state's
        noise."""
        model = put_in(self.base, state.fit.model, found)
        try:
            fitted = fit(model, self.session, close=NEAR, near=state.fit, **state.fit.judged)
            return self._standing(fitted, found)[0]
        except JobError:
            return -math.inf

    def _repeat(self, state: ExplainedSession, functions: bool = False) -> ExplainedSession:
        """Explain and fit while that is better; with `functions`, propose new ones each time."""
        for _ in range(ROUNDS):
            self._scan(state)
            if functions:
                tolerance = self._standing(state.fit, state.found)[1]
                self.functions = propose_functions(
                    state.fit, state.found, self.candidates, tolerance
                )
            explained = self._explain_better(state)
            if explained is None:
                break
            for f in explained.found:
                self.say(Candidate(f.name, f.terms).label)
            taken = self._fit_with(state, tuple(map(loosen, explained.found)))
            if taken is None:
                break
            taken = self._move_forms(taken)
            if not self._rose(state, taken):
                break
            state = taken
        return state

    def _by_halves(self, state: ExplainedSession, seed: int) -> ExplainedSession:
        """Try on all rows the explanations of either half of them, where functions are needed.

        Of many causes none may be worth its price while the others count as noise, so that the
        ascent stops early.  On other rows it stops elsewhere.  What each half finds by itself is
        also a sample of what another session would show.
        """
        if not any(f.unnamed for f in state.found):
            return state
        for rows in split_in_half(self.session, seed):
            half = replace(self, session=self.session.take(rows))
            begun = half._fit_with(state, ())
            if begun is None:
                continue
            found = half._repeat(begun, functions=True).found
            self.of_halves = (*self.of_halves, found)
            taken = self._fit_with(state, tuple(map(loosen, found)))
            if taken is not None and self._odds(state, taken) > BETTER:
                state = self._repeat(taken, functions=True)
        return state

    def _explain_better(self, state: ExplainedSession) -> Explained | None:
        """Return the best explanation by any tolerance, or None if the present one is as good.

        The likeliest tolerance is tried first.  Those by which the best explanation is impossible
        are not tried.
        """
        left = self._offer_by_tolerance(state.fit, state.found)
        first = max(left, key=lambda bank: bank.standing)
        left.remove(first)
        best = first.explain()
        while left:
            likeliest = max(left, key=lambda bank: bank.evidence_of(best))
            if likeliest.evidence_of(best) < best.evidence + math.log(IMPOSSIBLE):
                break
            left.remove(likeliest)
            best = max(best, likeliest.explain(best.effects), key=lambda e: e.evidence)
        return best if best.evidence >= first.standing + BETTER else None

    def _rose(self, before: ExplainedSession, now: ExplainedSession) -> bool:
        """Tell whether the explanation in the model, once fitted, is better than the one before.

        The columns are those of small changes. Where two effects need each other, as a load needs a
        part that yields, one alone seems to do what only both can.  So each explanation counts with
        all of its effects, also those that are not worth their price: else it could not replace the
        same one with more effects.
        """
        was = before.fit
        again = fit(was.model, self.session, close=NEAR, begun=was, **now.fit.judged)
        least = self._whole(again, before.found, near=now.fit) + BETTER
        return self._whole(now.fit, now.found) > least

    def _standing(
        self, fitted: ModelFit, found: Sequence[FoundEffect]
    ) -> tuple[float, ModelTolerance]:
        """Return the log evidence of an explanation at its best tolerance, and that tolerance."""
        every = self._offer_by_tolerance(fitted, found, others=False)
        return max((bank.pruned, bank.tolerance) for bank in every)

    def _rest(self, state: ExplainedSession) -> float:
        """Return how much every other part yields (`ModelTolerance.compliance`), once the names are
        decided.

        Where one part has a name for being soft, equally soft others are no cause of their own.
        """
        soft = any(t.elastic for f in state.found for t in f.terms)
        every = self._offer_by_tolerance(state.fit, state.found, others=False)
        best = max(every, key=lambda b: b.pruned - b.tolerance.log_prior * soft)
        return best.tolerance.compliance

    def _whole(self, fitted: ModelFit, found: Sequence[FoundEffect], **near: ModelFit) -> float:
        """Return the log evidence of all effects of an explanation in the model.

        None of them is dropped: the columns tell little about the arm without an effect that is
        large.
        """
        every = self._offer_by_tolerance(fitted, found, others=False, **near)
        return max(bank.standing for bank in every)

    def _compare_rivals(
        self, state: ExplainedSession
    ) -> tuple[ExplainedSession, tuple[FoundEffect, ...], bool]:
        """Converge the fit, and compare every effect with those that may stand in its place.

        Returns:
            The state, the doubtful effects, and whether another effect was better somewhere, so
            that everything must be explained again.
        """
        was = state.fit
        state = replace(state, fit=fit(was.model, self.session, begun=was, **was.judged))
        banks = self._offer_by_tolerance(state.fit, state.found)
        found, doubtful = max(banks, key=lambda b: b.standing).judge(state.found, banks)
        sure = tuple(f for f in found if f.there >= CREDIBLE)
        if len(sure) < len(found) and (fewer := self._fit_with(state, sure)) is not None:
            return fewer, (*doubtful, *(f for f in found if f.there < CREDIBLE)), True
        state = replace(state, found=sure)
        here = self._whole(state.fit, sure)
        for k, mine in enumerate(sure):
            worth = {
                rival.name: self._evidence_refitted(
                    state, instead(state.found, k, mine.led_by(rival, ()))
                )
                - here
                for rival in mine.fitted_rivals
            }
            judged, better = mine.against(worth)
            if better:
                taken = self._fit_with(state, instead(state.found, k, judged))
                if taken is not None:
                    return taken, doubtful, True
            else:
                found = (*state.found[:k], judged, *state.found[k + 1 :])
                state = replace(state, found=found)
        return state, doubtful, False

    def _held_against_absence(
        self, state: ExplainedSession
    ) -> tuple[ExplainedSession, dict[str, tuple[FoundEffect, float]]]:
        """Compare each name with the best explanation without it, and take the better one.

        Several functions may stand in the place of one name, and exchanging one effect for one
        never finds them. This is not tried where the explanation needs no function, nor for elastic
        effects.

        Returns:
            The state; and for each name that stays the function that would replace it, with the log
            odds of that explanation.
        """
        absence: dict[str, tuple[FoundEffect, float]] = {}
        held: set[str] = set()
        while any(f.unnamed for f in state.found):
            names = {f.name for f in state.found if not f.unnamed and not f.terms[0].elastic}
            if not names - held:
                break
            name = min(names - held)
            held.add(name)
            others = replace(self, candidates=[c for c in self.candidates if c.name != name])
            rest = tuple(f for f in state.found if not f.unnamed and f.name != name)
            left = others._fit_with(state, rest)
            left = None if left is None else others._repeat(left, functions=True)
            new = [] if left is None else [f for f in left.found if f.unnamed]
            if left is None or not new:
                continue
            odds = self._odds(state, left)
            if odds > 0:
                state = left
            else:
                absence[name] = new[0], odds
        return state, absence

    def _odds(self, one: ExplainedSession, other: ExplainedSession) -> float:
        """Return the log odds of `other` against `one`: the mean of those at the noise of
        either."""
        made = []
        for judged in (one.fit.judged, other.fit.judged):
            fits = (fit(e.fit.model, self.session, close=NEAR, **judged) for e in (one, other))
            mine, theirs = (
                self._whole(f, e.found) for f, e in zip(fits, (one, other), strict=True)
            )
            made.append(theirs - mine)
        return sum(made) / len(made)

    def _evidence_refitted(self, state: ExplainedSession, found: tuple[FoundEffect, ...]) -> float:
        """Return the log evidence of other effects in the place of a state's, fitted with the same
        noise.

        It is -inf where two of them share a place or the fit fails.
        """
        places = [t.key for f in found for t in f.terms]
        if len(set(places)) < len(places):
            return -math.inf
        try:
            model = put_in(self.base, state.fit.model, found)
            begun = fit(model, self.session, close=NEAR, near=state.fit, **state.fit.judged)
            return self._whole(begun, found, near=state.fit)
        except JobError:
            return -math.inf

    def _offer_by_tolerance(
        self,
        fitted: ModelFit,
        found: Sequence[FoundEffect],
        others: bool = True,
        near: ModelFit | None = None,
    ) -> list[OfferedEffects]:
        """Offer effects on top of a fit, once for each model tolerance that applies.

        Tolerances with another form than the first are tried only if something was found.
        """
        tried = [
            tolerance
            for tolerance in TOLERANCES
            if (found or tolerance.form == FORMS[0]) and (self.nameless or not tolerance.soft)
        ]
        return make_offers(
            fitted, self.candidates, self.functions, found, tried, others=others, near=near
        )

    def _scan(self, state: ExplainedSession) -> None:
        """Replace the scanned candidates by the steps that the residual shows now."""
        need = NONE + math.log(max(len(self.candidates), 1))
        shown = [c for kind in self.stepped for c in scan(state.fit, kind, need)]
        self.candidates = [*(c for c in self.candidates if not c.scanned), *shown]

    def _fit_with(
        self, state: ExplainedSession, found: tuple[FoundEffect, ...]
    ) -> ExplainedSession | None:
        """Fit the model with these effects; None where the fit diverges."""
        model = put_in(self.base, state.fit.model, found)
        try:
            return judge_noise_and_fit(
                model, self.session, self.candidates, found, state, known=self.known
            )
        except JobError:
            return None

    def _move_forms(self, state: ExplainedSession) -> ExplainedSession:
        """Move forms on a scale to where the evidence is highest, while more rows agree.

        A form that stays is not looked at again.
        """
        terms = [t for f in state.found for t in f.terms]
        while moved := better_forms(state.fit, terms, self.candidates):
            terms = list(moved.values())
            for term in moved.values():
                self.say(Candidate(term.name, (term,)).label)
            found = tuple(
                replace(f, terms=tuple(moved.get(t.key, t) for t in f.terms)) for f in state.found
            )
            taken = self._fit_with(state, found)
            before = agreement(state.fit, state.fit.residual)
            if taken is None or agreement(state.fit, taken.fit.residual) < before + BETTER:
                break
            state = taken
        return state
