"""How joints remember: radii of the play that winds up, and the length of unrecorded run-ups.

Both belong to the whole session and are no parameters of a fit, so they are sought before the
search, where the evidence is highest with all that the library holds beside them, and once more
on top of what the search found.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SLIDE
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.candidates import Candidate, CandidateColumns, distinct
from longarm_comp.core.identify.evidence import columns_at
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import from_residual
from longarm_comp.core.identify.posterior.explain import ExplainedSession
from longarm_comp.core.identify.posterior.single_effects import NONE
from longarm_comp.core.model.model import Model

RUN_UPS = (0.02, 0.035, 0.05, 0.07, 0.1)
"""Lengths that are tried first (rad); the data hardly tell a factor of 1.5."""
NEAR = (0.65, 0.85, 1.2)
"""Smaller radii that are tried, per run-up: below half of it none differs from the side alone."""
FAR = (0.08, 0.15, 0.28)
"""Larger radii that are tried first (rad)."""
FARTHEST = 0.6
"""Largest radius (rad)."""
_FINER = (1.25, 1.1, 1.04)
"""Steps of the search, as factors; the last is finer than the data tell a radius."""
_WORTH = 0.1
"""Log evidence that a step must bring: less is no reason to go on."""
AnyTerm = TypeVar("AnyTerm", bound=Effect | Bias)


def remembers(term: Effect | Bias) -> bool:
    """Whether an effect is of its joint's history, with radii of memory in its form."""
    return isinstance(term, Effect) and term.remembers


@dataclass(frozen=True)
class WindUp:
    """What was found; rad, and a tenth as many m for a slide.

    Attributes:
        near, far: radii of the play operators that remember.
        run_up: length of the run-ups of which only the side was recorded; 0: there are none.
        log_bayes_factor: against lost motion that the side alone decides.
    """

    near: float
    far: float
    run_up: float
    log_bayes_factor: float = -math.inf

    def candidates(self, library: Iterable[Candidate]) -> tuple[Candidate, ...]:
        """The candidates with these radii."""
        return tuple(Candidate(c.name, self.terms(c.terms)) for c in library)

    def terms(self, terms: Iterable[AnyTerm]) -> tuple[AnyTerm, ...]:
        """Terms with these radii."""
        forms: dict[str, Any] = {"near": self.near, "far": self.far, "run_up": self.run_up}

        def shaped(term: AnyTerm) -> AnyTerm:
            if not remembers(term):
                return term
            return dataclasses.replace(term, **forms)

        return tuple(map(shaped, terms))


def with_run_ups(session: Session, arm: Arm, run_up: float) -> Session:
    """The session with unrecorded run-ups taken to be so long (rad; a tenth as many m)."""
    slides = [arm.joints[row - 1].type == "prismatic" for row in arm.commanded]
    return session.taken(run_up * np.where(slides, SLIDE, 1.0))


def as_fitted(session: Session, model: Model) -> Session:
    """The session with unrecorded run-ups taken to be as long as a model was fitted with."""
    taken = [float(e.forms["run_up"]) for e in model.effects if remembers(e)]
    longest = max(taken, default=0.0)
    return with_run_ups(session, model.arm, longest) if longest else session


def wind_up(
    model: Model, rows: Callable[[float], Session], candidates: Sequence[Candidate]
) -> WindUp | None:
    """Radii and run-up of the highest evidence; None where nothing shows that a joint remembers.

    Args:
        model: with its geometry, fitted or not.
        rows: the rows to fit, with unrecorded run-ups taken to be so long (rad).
        candidates: the library.
    """
    families = [tuple(t for t in c.terms if remembers(t)) for c in candidates]
    terms = max(families, key=len, default=())
    if not terms:
        return None
    evidence = _Evidence.of_library(model, rows, candidates, terms)
    best = evidence.searched()
    tried = len(RUN_UPS) * len(NEAR) * len(FAR)
    return best if best.log_bayes_factor > math.log(tried) + NONE else None


def refined(
    traced: ExplainedSession, found: WindUp, rows: Callable[[float], Session]
) -> tuple[ExplainedSession, WindUp]:
    """Radii and run-up looked for again on top of what a search found, and all fitted anew.

    Args:
        traced: the search, with the radii and the run-up of ``found``.
        rows: as in `wind_up`.
    """
    was = traced.fit
    terms = tuple(t for t in was.model.effects if remembers(t))
    if not terms:
        return traced, found
    better = _Evidence.of_fit(was, rows, terms).finer(found)
    model = dataclasses.replace(was.model, effects=better.terms(was.model.effects))
    session = rows(better.run_up)
    again = fit(model, session, sigma=was.sigma, rho=was.rho, weights=was.weights)
    shaped = tuple(dataclasses.replace(f, terms=better.terms(f.terms)) for f in traced.found)
    return dataclasses.replace(traced, fit=again, found=shaped), better


@dataclass
class _Evidence:
    """The linear problem, with everything but the memory of joints marginalised."""

    fitted: ModelFit
    marginal: Marginal
    rows: Callable[[float], Session]
    terms: tuple[Effect | Bias, ...]
    side_alone: float = 0.0
    known: dict[float, CandidateColumns] = field(default_factory=dict)

    @classmethod
    def of_fit(
        cls,
        fitted: ModelFit,
        rows: Callable[[float], Session],
        terms: tuple[Effect | Bias, ...],
    ) -> _Evidence:
        """On top of the rest of a model that holds the terms."""
        rest = [not remembers(s.owner) for s in fitted.slots]
        return cls(fitted, Marginal(fitted.design[:, rest], fitted.data), rows, terms)

    @classmethod
    def of_library(
        cls,
        model: Model,
        rows: Callable[[float], Session],
        candidates: Sequence[Candidate],
        terms: tuple[Effect | Bias, ...],
    ) -> _Evidence:
        """On top of a model without the terms and of all else that the library holds."""
        fitted = fit(model, rows(_middle(RUN_UPS)))
        columns = columns_at(fitted)
        others = distinct(candidates, {t.key for t in terms})
        beside, mine = columns.of(others), columns.of(terms)
        noise, weights = from_residual(fitted, np.concatenate([beside, mine], axis=-1))
        fitted = dataclasses.replace(fitted, sigma=noise.sigma, rho=noise.rho, weights=weights)
        design = np.concatenate([fitted.design, fitted.whitened(beside)], axis=1)
        marginal = Marginal(design, fitted.data)
        widths = mine[..., :: len(terms[0].declared())]
        side_alone = float(marginal.added(fitted.whitened(widths)).log_bayes_factor)
        return cls(fitted, marginal, rows, terms, side_alone)

    def searched(self) -> WindUp:
        """All tried values with each other, then along one scale after the other, ever finer."""
        told = bool(self.rows(0.0).told.any())
        best = WindUp(0.0, 0.0, 0.0)
        for run_up in RUN_UPS if told else (0.0,):
            columns = self._columns(run_up)
            for share, far in itertools.product(NEAR, FAR):
                near = share * (run_up or _middle(RUN_UPS))
                best = max(best, self._at(near, far, run_up, columns), key=_evidence)
        return self.finer(best) if best.log_bayes_factor > 0 else best

    def finer(self, start: WindUp) -> WindUp:
        """Along one scale after the other, in ever smaller steps, as long as it gets better."""
        best = self._at(start.near, start.far, start.run_up, self._columns(start.run_up))
        for factor, name in itertools.product(_FINER, ("run_up", "far", "near")):
            for change in (factor, 1 / factor):
                while True:
                    moved = dataclasses.replace(best, **{name: getattr(best, name) * change})
                    if moved.near < NEAR[0] * moved.run_up or moved.far > FARTHEST:
                        break
                    columns = self._columns(moved.run_up)
                    found = self._at(moved.near, moved.far, moved.run_up, columns)
                    if found.log_bayes_factor < best.log_bayes_factor + _WORTH:
                        break
                    best = found
        return best

    def _columns(self, run_up: float) -> CandidateColumns:
        """With the arm where it was fitted: run-ups change what joints remember, hardly more."""
        if run_up not in self.known:
            session = self.rows(run_up)
            seen = session.take(session.seen)
            at = dataclasses.replace(self.fitted.posture, context=seen.context(), _cache={})
            self.known[run_up] = CandidateColumns(self.fitted.model, at, seen)
        return self.known[run_up]

    def _at(self, near: float, far: float, run_up: float, columns: CandidateColumns) -> WindUp:
        shape = WindUp(near, far, run_up)
        found = self.marginal.added(self.fitted.whitened(columns.of(shape.terms(self.terms))))
        evidence = float(found.log_bayes_factor) - self.side_alone
        return dataclasses.replace(shape, log_bayes_factor=evidence)


def _evidence(found: WindUp) -> float:
    return found.log_bayes_factor


def _middle(values: Sequence[float]) -> float:
    return values[len(values) // 2]
