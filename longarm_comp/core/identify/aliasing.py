"""Name or set: which other effects the data could not tell from the one that was found."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, Columns, Term
from longarm_comp.core.identify.evidence import Score, columns_at, key, marginal_without, score
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.partial_aliases import CLOSE, Part, parts
from longarm_comp.core.identify.refine_forms import reshaped
from longarm_comp.core.identify.search import SearchResult

ALIASES: tuple[frozenset[str], ...] = (
    frozenset({"joint_compliance", "servo_droop"}),  # proportional sag is a compliance
)
"""Effects that no pose can tell apart, whatever is measured."""


FEW = 3
"""On so few levels of a joint, any function of it is an offset and two numbers."""
ANY_FUNCTION = ("gear_eccentricity", "servo_quantisation")
"""Effects that can take any values at three levels of a joint (of steps of an unknown size)."""
OF_ONE_JOINT = (*ANY_FUNCTION, "joint_gain")


@dataclass(frozen=True)
class Finding:
    """One effect that the data ask for, with what they cannot tell from it.

    Attributes:
        name: canonical name.
        terms: the fitted instances.
        log_bayes_factor: against leaving the effect out, geometry and rest marginalised.
        alternatives: other effects that explain the same, best first.
        runner_up: the best other effect, told apart or not; None if there is none.
        effect_m: RMS shift of the tip that it stands for, m.
        parts: effects that could stand for a part of it, best first.
    """

    name: str
    terms: tuple[Term, ...]
    log_bayes_factor: float
    alternatives: tuple[Score, ...]
    runner_up: Score | None
    effect_m: float
    parts: tuple[Part, ...] = ()

    @property
    def where(self) -> tuple[str, ...]:
        """Places, in order."""
        return tuple(dict.fromkeys(t.where for t in self.terms))

    @property
    def names(self) -> tuple[str, ...]:
        """The effect and what cannot be told from it."""
        return tuple(dict.fromkeys((self.name, *(a.candidate.name for a in self.alternatives))))


def findings(traced: SearchResult, candidates: Sequence[Candidate]) -> list[Finding]:
    """Every found effect with its look-alikes, strongest first."""
    columns = columns_at(traced.fit)
    made = []
    for name in dict.fromkeys(t.name for t in traced.chosen):
        terms = tuple(_fitted(traced, t) for t in traced.chosen if t.name == name)
        made.append(_finding(traced, candidates, columns, name, terms))
    return sorted(made, key=lambda f: -f.log_bayes_factor)


def with_parts(
    traced: SearchResult, candidates: Sequence[Candidate], found: Sequence[Finding]
) -> tuple[Finding, ...]:
    """Findings with what could stand for a part of each."""
    columns = columns_at(traced.fit)
    chosen = {t.name for t in traced.chosen}
    return tuple(
        dataclasses.replace(
            f, parts=parts(traced, candidates, columns, f.terms, chosen.union(f.names))
        )
        for f in found
    )


def on_few_levels(
    traced: SearchResult, candidates: Sequence[Candidate], found: Finding, levels: np.ndarray
) -> Finding:
    """A finding with what nobody could tell from it on a coarse grid, whatever the evidence says.

    Args:
        traced: the search.
        candidates: the library.
        found: the finding.
        levels: (n,) distinct values of every commanded joint in all rows that were looked at.
    """
    commanded = traced.fit.model.arm.commanded
    joints = [t.placement.get("joint") for t in found.terms]
    if found.name not in OF_ONE_JOINT or any(levels[commanded.index(j)] > FEW for j in joints):
        return found
    columns = columns_at(traced.fit)
    marginal = marginal_without(traced.fit, columns, {key(t) for t in found.terms})
    added = []
    for name in ANY_FUNCTION:
        if name in found.names:
            continue
        options = [c for c in candidates if c.name == name]
        scores = [score(traced.fit, marginal, c, columns) for c in options]
        added += sorted(scores, key=lambda s: -s.log_bayes_factor)[:1]
    return dataclasses.replace(found, alternatives=(*found.alternatives, *added))


def without(traced: SearchResult, places: set[tuple[str, str]]) -> Marginal:
    """Evidence on top of the final fit, the terms at some places taken out of it."""
    return marginal_without(traced.fit, columns_at(traced.fit), places)


def _fitted(traced: SearchResult, term: Term) -> Term:
    return next(
        t for t in traced.fit.model.terms if key(t) == key(term) and t.placement == term.placement
    )


def _finding(
    traced: SearchResult,
    candidates: Sequence[Candidate],
    columns: Columns,
    name: str,
    terms: tuple[Term, ...],
) -> Finding:
    places = {key(t) for t in terms}
    marginal = marginal_without(traced.fit, columns, places)
    mine = Candidate(name, terms)
    own = score(traced.fit, marginal, mine, columns)
    fixed = not _size(traced, mine)
    limit = own.fit_gain if fixed else _likelihood(traced, marginal, columns, mine)
    held = {key(t) for t in traced.chosen}
    best: dict[str, Score] = {}
    close: dict[str, Score] = {}
    for other in _others(candidates, name, terms):
        new = tuple(t for t in other.terms if key(t) not in held)
        if not new:
            continue
        option = Candidate(other.name, new)
        scored = score(traced.fit, marginal, option, columns)
        if other.name not in best or scored.log_bayes_factor > best[other.name].log_bayes_factor:
            best[other.name] = scored
        alike = scored.log_bayes_factor > own.log_bayes_factor - CLOSE
        if not alike and _size(traced, option) <= _size(traced, mine) + 1:
            alike = _likelihood(traced, marginal, columns, option) > limit - CLOSE
        alias = any({name, other.name} <= family for family in ALIASES)
        known = close.get(other.name)
        if (alike or alias) and (known is None or scored.log_bayes_factor > known.log_bayes_factor):
            close[other.name] = scored
    ranked = sorted(best.values(), key=lambda s: -s.log_bayes_factor)
    alternatives = sorted(close.values(), key=lambda s: -s.log_bayes_factor)
    return Finding(
        name,
        terms,
        own.log_bayes_factor,
        tuple(alternatives),
        ranked[0] if ranked else None,
        own.effect_m,
    )


def _others(candidates: Sequence[Candidate], name: str, terms: tuple[Term, ...]) -> list[Candidate]:
    """Other effects: as they are, at the places that were found only, and in the found forms."""
    joints = {t.placement["joint"] for t in terms if "joint" in t.placement}
    made = reshaped(terms, candidates)
    for other in candidates:
        if other.name == name:
            continue
        made.append(other)
        same = tuple(t for t in other.terms if t.placement.get("joint") in joints)
        if 1 < len(same) < len(other.terms):
            made.append(Candidate(other.name, same))
    return made


def _size(traced: SearchResult, candidate: Candidate) -> int:
    return len(candidate.slots(traced.fit.model.arm))


def _likelihood(
    traced: SearchResult, marginal: Marginal, columns: Columns, candidate: Candidate
) -> float:
    """Gain in log likelihood with the candidate's own priors taken away."""
    if not _size(traced, candidate):
        return -np.inf
    b = traced.fit.whitened(columns.of(candidate.terms))
    gram = b.T @ marginal.project(b)
    t = b.T @ marginal.py
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    good = values > 1e-9 * max(float(values.max(initial=0.0)), 1e-12)
    u = vectors[:, good].T @ t
    return float((u * u / values[good]).sum() / 2)
