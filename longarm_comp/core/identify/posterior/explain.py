"""The search for what the model lacks: a posterior over explanations, and the model refitted.

Each round takes the session's equations at the model as it is, offers every effect of the library
and functions without a name (`offers.py`), computes the posterior over them (`posterior.py`), puts
the most probable explanation into the model, and fits that.  Noise and outliers are judged anew,
and forms on a scale move to where the evidence is highest.  It ends when the explanation repeats.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field

from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.errors import JobError
from longarm_comp.core.identify import noise as noise_step
from longarm_comp.core.identify.candidates import Candidate, Term, distinct
from longarm_comp.core.identify.evidence import FitColumns, columns_at, refined
from longarm_comp.core.identify.fit import fit, unfitted
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import NoiseEstimate
from longarm_comp.core.identify.posterior.found import CREDIBLE, FoundEffect, Proposition
from longarm_comp.core.identify.posterior.offered_effects import OfferedEffects
from longarm_comp.core.identify.posterior.offers import TOLERANCES, offered
from longarm_comp.core.identify.posterior.propositions import propositions
from longarm_comp.core.identify.posterior.single_effects import NONE
from longarm_comp.core.identify.step_scan import UnknownStep, scan
from longarm_comp.core.identify.thresholds import retuned
from longarm_comp.core.model.model import Model

LOOSE = 3.0
"""Times the amount of a function that its prior must reach, so that it hardly pulls at it."""
ROUNDS = 8
"""Of posterior and fit, at most, of the library and then of functions; three are usual."""
REFORMED = 3
"""Times that forms are moved between two rounds, each time with the rest as it has become."""
BETTER = 1.0
"""Log evidence by which an explanation must be better to take the place of the one in the model."""
STEPS = 6
"""Gauss-Newton steps of a fit between rounds; the last fit converges."""
NEAR = 0.3
"""Last step of such a fit, in standard errors: the next would be a tenth of it or less."""


@dataclass(frozen=True)
class ExplainedSession:
    """The outcome of a search.

    Attributes:
        fit: the final model, fitted.
        found: the single effects in the model, with their credible sets.
        doubtful: single effects that may be there, not in the model.
        noise: as judged last.
        candidates: the library as it was offered last.
        unknown_steps: where steps show, but not their size.
        tolerance: share of its own shift by which the form of what was found may err.
    """

    fit: ModelFit
    found: tuple[FoundEffect, ...]
    doubtful: tuple[FoundEffect, ...]
    noise: NoiseEstimate
    candidates: tuple[Candidate, ...]
    unknown_steps: tuple[UnknownStep, ...] = ()
    tolerance: float = 0.0

    @property
    def chosen(self) -> tuple[Term, ...]:
        """The terms in the model, as they were offered."""
        return tuple(t for f in self.found for t in f.terms)

    @property
    def need(self) -> float:
        """Log Bayes factor from which on a candidate is more likely there than not."""
        return NONE + math.log(max(len(self.candidates), 1))


def explain_session(
    base: Model,
    session: Session,
    candidates: Sequence[Candidate],
    *,
    known_noise: NoiseEstimate | None = None,
    stepped: Sequence[type[Effect]] = (),
    functions: bool = True,
    progress: Callable[[str], None] | None = None,
) -> ExplainedSession:
    """Find what the model lacks.

    Args:
        base: the declared model with its geometry terms.
        session: training rows.
        candidates: the library.
        known_noise: from repeats; judged from the residual otherwise.
        stepped: effects whose steps are scanned.
        functions: whether functions without a name are offered.
        progress: told what is going on.

    Raises:
        InputError, JobError: as `fit`.
    """
    state = _Exploration(base, session, list(candidates), known_noise, stepped, functions)
    return state.searched(progress or (lambda _: None))


@dataclass
class _Exploration:
    """The model while it is searched for."""

    base: Model
    session: Session
    candidates: list[Candidate]
    known: NoiseEstimate | None
    stepped: Sequence[type[Effect]]
    functions: bool
    found: tuple[FoundEffect, ...] = ()
    propositions: tuple[Proposition, ...] = ()
    unknown: dict[str, UnknownStep] = field(default_factory=dict)
    fit: ModelFit = field(init=False)
    noise: NoiseEstimate = field(init=False)
    columns: FitColumns = field(init=False)
    _changed: bool = False

    def searched(self, say: Callable[[str], None]) -> ExplainedSession:
        say("geometry")
        self._fit(self.base)
        self._repeat(say, lambda: ())
        if self.functions:
            self._repeat(say, lambda: propositions(self.fit, self.found))
        doubtful = self._compared()
        if self._changed:
            self._repeat(say, lambda: self.propositions)
            doubtful = self._compared()
        found, tolerance = self.found, self._standing(self.fit, self.found)[1]
        return ExplainedSession(
            self.fit,
            found,
            doubtful,
            self.noise,
            tuple(self.candidates),
            tuple(self.unknown.values()),
            tolerance,
        )

    def _repeat(
        self, say: Callable[[str], None], functions: Callable[[], tuple[Proposition, ...]]
    ) -> None:
        """Explain and fit as long as a better explanation is found."""
        for _ in range(ROUNDS):
            self._scan()
            self.propositions = functions()
            banks = self._offered()
            explained = max((b.explained() for b in banks), key=lambda e: e.evidence)
            standing = max(b.standing for b in banks)
            if explained.evidence < standing + BETTER:
                break
            for f in explained.found:
                say(Candidate(f.name, f.terms).label)
            before = self.found, self.fit, self.noise, self.columns
            if not self._take(tuple(map(_loose, explained.found))):
                break
            for _ in range(REFORMED):
                if not self._reform(say):
                    break
            if not self._rose(before[1], before[0]):
                self.found, self.fit, self.noise, self.columns = before
                break

    def _rose(self, fitted: ModelFit, found: tuple[FoundEffect, ...]) -> bool:
        """Whether the explanation in the model is better, once fitted, than the one before.

        Columns are those of small changes: of two effects that need each other, as a load needs
        what gives way, one seems to do what only both can.
        """
        now = self.fit
        again = fit(
            fitted.model, self.session, sigma=now.sigma, rho=now.rho, weights=now.weights,
            max_iterations=STEPS, close=NEAR, begun=fitted,
        )  # fmt: skip
        return self._standing(now, self.found)[0] > self._standing(again, found)[0] + BETTER

    def _standing(self, fitted: ModelFit, found: Sequence[FoundEffect]) -> tuple[float, float]:
        """Log evidence of an explanation that is fitted, and the tolerance where it is highest."""
        columns, library = columns_at(fitted), self.candidates
        if not found:
            return columns.without(()).evidence, TOLERANCES[0]
        every = (
            offered(fitted, columns, library, self.propositions, found, t, others=False)
            for t in TOLERANCES
        )
        return max((bank.pruned, bank.tolerance) for bank in every)

    def _compared(self) -> tuple[FoundEffect, ...]:
        """Take the fit to its end, and compare what may stand in the place of every effect.

        Returns what is doubtful. Where another effect is better, all else is explained anew.
        """
        self._changed = False
        self._settle()
        found, doubtful = max(self._offered(), key=lambda b: b.standing).judged(self.found)
        sure = tuple(f for f in found if f.there >= CREDIBLE)
        if len(sure) < len(found) and self._take(sure):
            self._settle()
            doubtful = (*doubtful, *(f for f in found if f.there < CREDIBLE))
        self.found = sure
        for k in range(len(self.found)):
            if not self._changed:
                self._compare(k)
        return doubtful

    def _compare(self, number: int) -> None:
        """Fit what may stand in the place of one effect; its probability is that of the fit.

        But for what no measurement distinguishes from it, and for functions, which need no other
        effect: of these the columns tell all.
        """
        mine, here = self.found[number], self._standing(self.fit, self.found)[0]
        same = {name for name, p in mine.names if p >= mine.names[0][1] and name != mine.name}
        same |= {c.name for c, _ in mine.rivals if not c.terms[0].searched}
        worth: dict[str, float] = {}
        for rival, _ in mine.rivals:
            if rival.name not in same:
                worth[rival.name] = self._instead(number, rival) - here
        if not worth:
            return
        share = {n: p for n, p in mine.names if n == mine.name or n in same}
        total = sum(share.values()) or 1.0
        odds = {n: math.exp(min(w, 700.0)) for n, w in worth.items()}
        whole = 1.0 + sum(odds.values())
        names = {n: p / total / whole for n, p in share.items()}
        names |= {n: o / whole for n, o in odds.items()}
        rivals = [(c, mine.log_bayes_factor + worth.get(c.name, 0.0)) for c, _ in mine.rivals]
        best, terms = max(worth, key=lambda name: worth[name]), mine.terms
        if worth[best] > 0:
            first = next(c for c, _ in rivals if c.name == best)
            rest = [(c, factor) for c, factor in rivals if c.name != best]
            rivals = [(Candidate(mine.name, mine.terms), mine.log_bayes_factor), *rest]
            terms = first.terms
        ordered = sorted(names.items(), key=lambda c: (c[0] != terms[0].name, -c[1]))
        judged = dataclasses.replace(mine, terms=terms, names=tuple(ordered), rivals=tuple(rivals))
        found = (*self.found[:number], judged, *self.found[number + 1 :])
        if worth[best] <= 0:
            self.found = found
        else:
            self._changed = self._take(found)

    def _instead(self, number: int, rival: Candidate) -> float:
        """Log evidence with a rival in the place of one effect, fitted."""
        taken = dataclasses.replace(self.found[number], terms=rival.terms)
        found = (*self.found[:number], taken, *self.found[number + 1 :])
        known = {t.variant: t for t in self.fit.model.terms}
        terms = [known.get(t.variant, t) for f in found for t in f.terms]
        now = self.fit
        if len({t.key for t in terms}) < len(terms):
            return -math.inf
        try:
            fitted = fit(
                _with(self.base, now.model, terms), self.session, sigma=now.sigma, rho=now.rho,
                weights=now.weights, max_iterations=STEPS, close=NEAR, near=now,
            )  # fmt: skip
        except JobError:
            return -math.inf
        return self._standing(fitted, found)[0]

    def _offered(self) -> list[OfferedEffects]:
        """By tolerance of the forms of what is in the model; one where there is nothing."""
        tried = TOLERANCES if self.found else TOLERANCES[:1]
        library, functions = self.candidates, self.propositions
        return [offered(self.fit, self.columns, library, functions, self.found, t) for t in tried]

    def _scan(self) -> None:
        """Offer the steps that the residual shows."""
        need = NONE + math.log(max(len(self.candidates), 1))
        scans = [scan(self.fit, self.columns, kind, need) for kind in self.stepped]
        shown = [candidate for each in scans for candidate in each.found]
        self.candidates = [*(c for c in self.candidates if not c.scanned), *shown]
        self.unknown |= {each.where: each for made in scans for each in made.unknown}

    def _take(self, found: tuple[FoundEffect, ...]) -> bool:
        """Fit the model with what was found; False, and nothing changed, where that runs away."""
        known = {t.variant: t for t in self.fit.model.terms}
        terms = [known.get(t.variant, t) for f in found for t in f.terms]
        before = self.found, self.fit, self.noise, self.columns
        try:
            self.found = found
            self._fit(_with(self.base, self.fit.model, terms))
        except JobError:
            self.found, self.fit, self.noise, self.columns = before
            return False
        return True

    def _fit(self, model: Model) -> None:
        """Judge the noise by all that the library could explain, then fit."""
        first = unfitted(model, self.session, self.fit) if self.found else fit(model, self.session)
        at = self.columns if self.found else columns_at(first)
        held = {t.key for f in self.found for t in f.terms}
        judged, weights = noise_step.from_residual(first, at.of(distinct(self.candidates, held)))
        self.noise = judged if self.known is None else noise_step.agreed(self.known, judged)
        self.fit = fit(
            first.model, self.session, sigma=self.noise.sigma, rho=self.noise.rho, weights=weights,
            max_iterations=STEPS, close=NEAR, begun=first,
        )  # fmt: skip
        self._look()

    def _settle(self) -> None:
        """Take the last fit to its end."""
        was = self.fit
        self.fit = fit(
            was.model, self.session, sigma=was.sigma, rho=was.rho, weights=was.weights, begun=was
        )
        self._look()

    def _look(self) -> None:
        self.columns = columns_at(self.fit)
        self.columns.prepare(distinct(self.candidates))

    def _reform(self, say: Callable[[str], None]) -> bool:
        """Move forms on a scale to where the evidence is highest; whether any moved."""
        terms = {t.key: t for f in self.found for t in f.terms}
        moved = dict(terms)
        for key, term in terms.items():
            if not term.scales():
                continue
            fitted = next(t for t in self.fit.model.terms if t.key == key)
            better = retuned(self.fit, self.columns, fitted)
            if better is fitted:
                marginal = self.columns.without({key})
                best = refined(self.fit, marginal, self.columns, term, self.candidates)
                better = best.candidate.terms[0]
            if better.variant != term.variant:
                moved[key] = better
                say(Candidate(term.name, (better,)).label)
        if moved == terms:
            return False
        return self._take(
            tuple(
                dataclasses.replace(f, terms=tuple(moved[t.key] for t in f.terms))
                for f in self.found
            )
        )


def _loose(found: FoundEffect) -> FoundEffect:
    """With a prior that hardly pulls at the amount of a function: that it is there is decided."""
    if not found.unnamed:
        return found
    terms = tuple(
        dataclasses.replace(t, scale=max(t.scale, LOOSE * abs(t.amount)))  # type: ignore
        for t in found.terms
    )
    return dataclasses.replace(found, terms=terms)


def without(model: Model, places: Container[tuple[str, str]]) -> Model:
    """A model without its terms at some places."""
    left = [t for t in model.terms if t.key not in places]
    return dataclasses.replace(
        model,
        effects=tuple(t for t in left if isinstance(t, Effect)),
        biases=tuple(t for t in left if isinstance(t, Bias)),
    )


def _with(base: Model, now: Model, terms: Sequence[Term]) -> Model:
    """The base model with further terms, the geometry started from the model as it is now."""
    known = {t.key: t for t in now.terms}
    every = [*(known.get(t.key, t) for t in base.terms), *terms]
    return dataclasses.replace(
        base,
        effects=tuple(t for t in every if isinstance(t, Effect)),
        biases=tuple(t for t in every if isinstance(t, Bias)),
    )
