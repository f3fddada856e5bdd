"""Parts of a finding that another effect could stand for: at one place, or one kind of parameter.

A servo's deadband and play are the same lost motion: beside a servo's sag nobody can tell which
it is, though either of them alone explains less than the two kinds of parameters together.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, Columns, Term
from longarm_comp.core.identify.evidence import Score, key, score
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.refine_forms import reshaped
from longarm_comp.core.identify.search import SearchResult
from longarm_comp.core.identify.search_state import ODDS

CLOSE = 3.0
"""Log evidence within which two explanations are not told apart."""


@dataclass(frozen=True)
class Part:
    """Another effect in the place of a part of a finding.

    Attributes:
        what: the part, in words: ``deadband``, ``part at joint 4``.
        score: the other effect, with the rest of the finding in the model.
        rival: whether it is so much better than the part that it may well be there instead: one
            in twenty, all candidates being as likely beforehand.
    """

    what: str
    score: Score
    rival: bool

    @property
    def name(self) -> str:
        """Canonical name of the other effect."""
        return self.score.candidate.name


def parts(
    traced: SearchResult,
    candidates: Sequence[Candidate],
    columns: Columns,
    terms: Sequence[Term],
    known: Set[str],
) -> tuple[Part, ...]:
    """What could stand for a part of a finding without loss; the best of each effect.

    A part counts only where its own evidence pays for a choice among all candidates: for what
    is hardly there, anything could stand.

    Args:
        traced: the search.
        candidates: the library.
        columns: of candidates at the fit's rows.
        terms: of the finding.
        known: effects that are found already, or cannot be told from the whole finding.
    """
    fit = traced.fit
    others = [c for c in candidates if c.name not in known]
    shaped = [c for c in reshaped(terms, candidates) if c.name not in known]
    best: dict[str, Part] = {}
    for what, taken in _slots_of_parts(traced, terms).items():
        rest = np.setdiff1d(np.arange(len(fit.slots)), taken)
        marginal = Marginal(fit.design[:, rest], fit.data)
        own = marginal.added(fit.design[:, taken]).log_bayes_factor
        if own < traced.threshold:
            continue
        for other in (*others, *shaped):
            if len(other.slots(fit.model.arm)) > len(taken) + 1:
                continue
            found = score(fit, marginal, other, columns)
            held = best.get(other.name)
            if found.log_bayes_factor > own - CLOSE and (
                held is None or found.log_bayes_factor > held.score.log_bayes_factor
            ):
                rival = found.log_bayes_factor - own > traced.threshold - ODDS - CLOSE
                best[other.name] = Part(what, found, rival)
    return tuple(sorted(best.values(), key=lambda p: -p.score.log_bayes_factor))


def _slots_of_parts(traced: SearchResult, terms: Sequence[Term]) -> dict[str, list[int]]:
    """Positions in the fit's slots of every part that is less than the whole."""
    mine = {key(t) for t in terms}
    made: dict[str, list[int]] = {}
    whole = [k for k, slot in enumerate(traced.fit.slots) if key(slot.owner) in mine]
    for k in whole:
        slot = traced.fit.slots[k]
        for what in (slot.parameter.name, f"part at {slot.owner.where}"):
            made.setdefault(what, []).append(k)
    return {what: taken for what, taken in made.items() if len(taken) < len(whole)}
