"""Name or set: which other effects the data cannot tell from a found one, or from a part of it.

A part is one place of the finding, or one kind of its parameters.  A servo's deadband and play
are the same lost motion: beside a servo's sag nobody can tell which of them it is, though either
alone explains less than the two kinds of parameters together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, Term, distinct
from longarm_comp.core.identify.confounded import untold
from longarm_comp.core.identify.evidence import (
    IMPLAUSIBLE,
    FitColumns,
    FitMarginal,
    Score,
    columns_at,
    key,
    marginal_without,
    pruned,
    reshaped,
    score,
    scores,
)
from longarm_comp.core.identify.minor import share, smallest, worth
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.search import SearchResult
from longarm_comp.core.identify.search_state import ODDS
from longarm_comp.core.model.encoders import tell_apart
from longarm_comp.core.model.model import slots_of

FEW = 3
"""On so few levels of a joint, any function of it is an offset and two numbers."""


MOST_NAMES = 7
"""A set of more names than this names nothing."""
CLOSE = 3.0
"""Log evidence within which the data do not distinguish two explanations."""


@dataclass(frozen=True)
class PartialAlias:
    """Another effect in the place of a part of a finding.

    Attributes:
        part: in words: ``deadband``, ``part at joint 4``.
        score: the other effect, with the rest of the finding in the model.
        rival: whether it is so much better than the part that it may well be there instead: one
            in twenty, all candidates being as likely beforehand.
    """

    part: str
    score: Score
    rival: bool

    @property
    def name(self) -> str:
        """Canonical name of the other effect."""
        return self.score.candidate.name


@dataclass(frozen=True)
class EffectFinding:
    """One effect that the data ask for, with what they cannot tell from it.

    Attributes:
        name: canonical name.
        terms: the fitted instances.
        log_bayes_factor: against leaving the effect out, geometry and rest marginalised.
        alternatives: other effects that explain the same, best first.
        runner_up: the best other effect, an alternative or not; None if there is none.
        worth_m: the same without what geometry and other effects could take up, m.
        share: what it takes of the mean squared error that the fitted rows would have without it.
        partial_aliases: effects that could stand for a part of it, best first.
        untold: what runs together with the recorded column that drives it.
        unnamed: why a cause without a name may be there instead; empty where it may not.
    """

    name: str
    terms: tuple[Term, ...]
    log_bayes_factor: float
    alternatives: tuple[Score, ...]
    runner_up: Score | None
    worth_m: float
    share: float
    partial_aliases: tuple[PartialAlias, ...] = ()
    untold: tuple[str, ...] = ()
    unnamed: str = ""

    @property
    def open(self) -> bool:
        """Whether it may as well be something else."""
        return bool(self.alternatives or self.untold or self.unnamed)

    @property
    def where(self) -> tuple[str, ...]:
        """Places, in order."""
        return tuple(dict.fromkeys(t.where for t in self.terms))

    @property
    def names(self) -> tuple[str, ...]:
        """The effect and what cannot be told from it."""
        return tuple(dict.fromkeys((self.name, *(a.candidate.name for a in self.alternatives))))


def findings(
    result: SearchResult, candidates: Sequence[Candidate]
) -> tuple[SearchResult, tuple[EffectFinding, ...]]:
    """Every found effect with its look-alikes, strongest first, and the search that it is of.

    An effect that could be almost anything, one found already too, is the remainder of a stronger
    one whose form is not quite the library's.  It gets no name: it is taken out of the search's
    result and stays in the residual, as structure.
    """
    columns = columns_at(result.fit)
    columns.prepare(distinct(candidates))
    found = []
    for name in dict.fromkeys(t.name for t in result.chosen):
        terms = tuple(_fitted(result, t) for t in result.chosen if t.name == name)
        found.append(_finding(result, candidates, columns, name, terms))
    found.sort(key=lambda f: -f.log_bayes_factor)
    for k, finding in enumerate(found):
        stronger = {f.name for f in found[:k]}
        if len(finding.names) > MOST_NAMES and stronger & set(finding.names):
            return findings(result.without({key(t) for t in finding.terms}), candidates)
    chosen = {t.name for t in result.chosen}
    return result, tuple(
        dataclasses.replace(
            f,
            partial_aliases=_partial_aliases(
                result, candidates, columns, f.terms, chosen.union(f.names)
            ),
            untold=untold(result.fit.session, result.fit.model.arm, f.terms),
            unnamed=_incredible(result.fit, f.terms) or _needless(result.fit, f.worth_m),
        )
        for f in found
    )


def on_few_levels(
    result: SearchResult, candidates: Sequence[Candidate], found: EffectFinding, q: np.ndarray
) -> EffectFinding:
    """A finding with what nobody could tell from it on a coarse grid, whatever the evidence says.

    Args:
        result: the search.
        candidates: the library.
        found: the finding.
        q: (N, n) commanded joints of all rows that were looked at.
    """
    coarse = set(np.array(result.fit.model.arm.commanded)[_levels(q) <= FEW])
    if not all(t.free_levels and coarse.issuperset(t.joints) for t in found.terms):
        return found
    columns = columns_at(result.fit)
    marginal = marginal_without(result.fit, columns, {key(t) for t in found.terms})
    added = []
    flexible = dict.fromkeys(c.name for c in candidates if c.terms[0].free_levels >= FEW)
    for name in flexible:
        if name in found.names:
            continue
        options = [c for c in candidates if c.name == name]
        scored = scores(result.fit, marginal, options, columns)
        added += sorted(scored, key=lambda s: -s.log_bayes_factor)[:1]
    return dataclasses.replace(found, alternatives=(*found.alternatives, *added))


def _incredible(fit: ModelFit, terms: Sequence[Term]) -> str:
    """Which parameter is of a size that nobody believes; empty where none is."""
    sizes = {
        f"{s.owner.where} {s.parameter.name}": abs(getattr(s.owner, s.parameter.name))
        / s.parameter.prior
        for s in slots_of(fit.model.arm, terms)
    }
    most = max(sizes, key=lambda label: sizes[label], default="")
    return f"{most} is implausibly large" if most and sizes[most] > IMPLAUSIBLE else ""


def _needless(fit: ModelFit, worth_m: float) -> str:
    """Whether the others could do without it, were they of sizes that nobody believes."""
    if worth_m >= smallest(fit):
        return ""
    own = f"only {1e3 * worth_m:.2g} mm at the tip are its own"
    return f"{own}; the other effects could take the rest"


def _levels(q: np.ndarray) -> np.ndarray:
    """(n,) distinct values of every joint, to a hundredth of its range."""
    span = np.maximum(np.ptp(q, axis=0), 1e-9)
    return np.array([len(np.unique(np.round(c, 2))) for c in (q / span).T])


def _fitted(result: SearchResult, term: Term) -> Term:
    return next(t for t in result.fit.model.terms if t.variant == term.variant)


def are_aliases(fit: ModelFit, one: Term, other: Term) -> bool:
    """Whether no pose can tell two effects apart by what the fit's session measured."""
    if other.name not in one.aliases and one.name not in other.aliases:
        return False
    arm = fit.model.arm
    return not tell_apart(arm, [arm.commanded[k] for k in fit.session.read_joints], one, other)


def _finding(
    result: SearchResult,
    candidates: Sequence[Candidate],
    columns: FitColumns,
    name: str,
    terms: tuple[Term, ...],
) -> EffectFinding:
    places = {key(t) for t in terms}
    marginal = marginal_without(result.fit, columns, places)
    mine = Candidate(name, terms)
    own = score(result.fit, marginal, mine, columns)
    fixed = not _size(result, mine)
    limit = own.fit_gain if fixed else _likelihood(result, marginal, columns, mine)
    held = {key(t) for t in result.chosen}
    best: dict[str, Score] = {}
    close: dict[str, Score] = {}
    left = (
        Candidate(c.name, tuple(t for t in c.terms if key(t) not in held))
        for c in _others(candidates, name, terms)
    )
    options = [option for option in left if option.terms]
    for scored in scores(result.fit, marginal, options, columns):
        option = scored.candidate
        new = option.terms
        if len(new) > 1 and scored.fit_gain > own.log_bayes_factor - CLOSE:
            fewer = pruned(result.fit, marginal, option, columns)
            again = score(result.fit, marginal, fewer, columns)
            if again.log_bayes_factor > scored.log_bayes_factor:
                option, scored = fewer, again
        other = option.name
        if other not in best or scored.log_bayes_factor > best[other].log_bayes_factor:
            best[other] = scored
        alike = scored.log_bayes_factor > own.log_bayes_factor - CLOSE
        small = _size(result, option) <= _size(result, mine) + 1
        if not alike and small and _plausible(result, marginal, columns, option):
            alike = _likelihood(result, marginal, columns, option) > limit - CLOSE
        alias = are_aliases(result.fit, terms[0], new[0])
        known = close.get(other)
        if (alike or alias) and (known is None or scored.log_bayes_factor > known.log_bayes_factor):
            close[other] = scored
    ranked = sorted(best.values(), key=lambda s: -s.log_bayes_factor)
    value = worth(result.fit, columns, terms)
    alternatives = sorted(close.values(), key=lambda s: -s.log_bayes_factor)
    return EffectFinding(
        name,
        terms,
        own.log_bayes_factor,
        tuple(alternatives),
        ranked[0] if ranked else None,
        value,
        share(result.fit, value),
    )


def _others(candidates: Sequence[Candidate], name: str, terms: tuple[Term, ...]) -> list[Candidate]:
    """Other effects: as they are, at the places that were found only, and in the found forms."""
    places = {place for t in terms for place in t.places.items()}
    made = reshaped(terms, candidates)
    for other in candidates:
        if other.name == name:
            continue
        made.append(other)
        same = tuple(t for t in other.terms if places & set(t.places.items()))
        if 1 < len(same) < len(other.terms):
            made.append(Candidate(other.name, same))
    return made


def _size(result: SearchResult, candidate: Candidate) -> int:
    return len(candidate.slots(result.fit.model.arm))


def _plausible(
    result: SearchResult, marginal: FitMarginal, columns: FitColumns, candidate: Candidate
) -> bool:
    """Whether it explains what it can without a size that nobody believes.

    Estimated with priors that are as wide as that, so that they hardly pull.
    """
    s, t = marginal.of([columns.scaled(candidate.terms)])[0]
    size = np.linalg.solve(s + np.eye(len(t)) / IMPLAUSIBLE**2, t)
    return bool((np.abs(size) <= IMPLAUSIBLE).all())


def _likelihood(
    result: SearchResult, marginal: FitMarginal, columns: FitColumns, candidate: Candidate
) -> float:
    """Gain in log likelihood with the candidate's own priors taken away."""
    if not _size(result, candidate):
        return -np.inf
    b = result.fit.whitened(columns.of(candidate.terms))
    gram = b.T @ marginal.project(b)
    t = b.T @ marginal.py
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    good = values > 1e-9 * max(float(values.max(initial=0.0)), 1e-12)
    u = vectors[:, good].T @ t
    return float((u * u / values[good]).sum() / 2)


def _partial_aliases(
    result: SearchResult,
    candidates: Sequence[Candidate],
    columns: FitColumns,
    terms: Sequence[Term],
    known: Set[str],
) -> tuple[PartialAlias, ...]:
    """What could stand for a part of a finding without loss; the best of each effect.

    A part counts only where its own evidence pays for a choice among all candidates: for what
    is hardly there, anything could stand.

    Args:
        result: the search.
        candidates: the library.
        columns: of candidates at the fit's rows.
        terms: of the finding.
        known: effects that are found already, or cannot be told from the whole finding.
    """
    fit = result.fit
    others = [c for c in candidates if c.name not in known]
    shaped = [c for c in reshaped(terms, candidates) if c.name not in known]
    best: dict[str, PartialAlias] = {}
    for part, taken in _slots_of_parts(result, terms).items():
        rest = np.setdiff1d(np.arange(len(fit.slots)), taken)
        marginal = FitMarginal(fit, rest)
        own = float(marginal.added(fit.design[:, taken]).log_bayes_factor)
        if own < result.threshold:
            continue
        arm, most = fit.model.arm, len(taken) + 1
        small = [c for c in (*others, *shaped) if len(c.slots(arm)) <= most]
        for found in scores(fit, marginal, small, columns):
            other = found.candidate
            held = best.get(other.name)
            if found.log_bayes_factor > own - CLOSE and (
                held is None or found.log_bayes_factor > held.score.log_bayes_factor
            ):
                rival = found.log_bayes_factor - own > result.threshold - ODDS - CLOSE
                best[other.name] = PartialAlias(part, found, rival)
    return tuple(sorted(best.values(), key=lambda p: -p.score.log_bayes_factor))


def _slots_of_parts(result: SearchResult, terms: Sequence[Term]) -> dict[str, list[int]]:
    """Positions in the fit's slots of every part that is less than the whole."""
    mine = {key(t) for t in terms}
    made: dict[str, list[int]] = {}
    whole = [k for k, slot in enumerate(result.fit.slots) if key(slot.owner) in mine]
    for k in whole:
        slot = result.fit.slots[k]
        for part in (slot.parameter.name, f"part at {slot.owner.where}"):
            made.setdefault(part, []).append(k)
    return {part: taken for part, taken in made.items() if len(taken) < len(whole)}
