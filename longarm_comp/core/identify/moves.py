"""Moves of the search that exchange what is found: two merged, one swapped, one split in two."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

from longarm_comp.core.identify.candidates import Candidate
from longarm_comp.core.identify.evidence import Score
from longarm_comp.core.identify.refine_forms import reshaped
from longarm_comp.core.identify.search_state import State

SWAP = 1.0
"""A new name must be this much (log) more probable than the one it replaces."""
COARSE = 50.0
"""A form this much (log) worse than the best may still win once its scale is sharpened."""
PAIRED = 6
"""Names, the best ones, of which every two are tried together in the place of one."""


def merge(state: State, say: Callable[[str], None]) -> bool:
    """Where two effects sit at one place, let one of them do, in another form if need be."""
    merged = False
    for where in dict.fromkeys(t.where for t in state.chosen.values()):
        places = [k for k, t in state.chosen.items() if t.where == where]
        if len(places) < 2:
            continue
        now = state.score(
            state.marginal(places), Candidate("", tuple(state.chosen[p] for p in places))
        )
        names = {name for name, _ in places}
        first: dict[str, Score] = {}
        for single in state.scores(places):
            close = single.log_bayes_factor > now.log_bayes_factor - COARSE
            if close and single.candidate.name in names and single.candidate.where == (where,):
                first.setdefault(single.candidate.name, single)
        options = [state.sharpened_form(s.candidate.terms[0], places) for s in first.values()]
        best = max(options, key=lambda s: s.log_bayes_factor, default=None)
        if best is not None and best.log_bayes_factor >= now.log_bayes_factor:
            say(f"{best.candidate.label} alone")
            state.exchange(places, best)
            merged = True
    return merged


def swap(state: State, say: Callable[[str], None]) -> bool:
    """Exchange a family for a better one, a better form, or more of what is there anyhow."""
    changed = False
    for name in dict.fromkeys(name for name, _ in state.chosen):
        if name not in state.names(()):
            continue  # pruned while others were exchanged
        places, marginal, now = state.family(name)
        terms = now.candidate.terms
        shaped = [state.score(marginal, c) for c in reshaped(terms, state.candidates)]
        options = sorted((*state.scores(places), *shaped), key=lambda s: -s.log_bayes_factor)
        form = now.candidate.form
        surplus = now.log_bayes_factor - state.threshold
        for option in options:
            other = option.candidate
            if (other.name, other.form) == (name, form):
                continue  # more places of the same are for `grow`, fewer for `prune`
            margin = 0.0 if other.name in state.names(places) else SWAP
            if option.log_bayes_factor - state.need(other.name, places) > surplus + margin:
                say(f"{other.label} instead of {name}")
                state.exchange(places, option)
                changed = True
                break
    return changed


def split(state: State, say: Callable[[str], None]) -> bool:
    """Let two effects take the place of one that does for both what neither does alone.

    A search that adds one effect at a time finds the compromise first.
    """
    for name in dict.fromkeys(name for name, _ in state.chosen):
        places, marginal, now = state.family(name)
        least = now.log_bayes_factor - state.threshold + SWAP
        forms: dict[str, list[Candidate]] = {}
        for option in state.scores(places):
            forms.setdefault(option.candidate.name, []).append(option.candidate)
        forms.pop(name, None)
        few = [form for options in list(forms.values())[:PAIRED] for form in options[:2]]
        both = [
            state.score(marginal, Candidate(f"{a.name} and {b.name}", (*a.terms, *b.terms)))
            for a, b in combinations(few, 2)
            if a.name != b.name
        ]
        best = max(both, key=lambda s: s.log_bayes_factor, default=None)
        if best is None:
            continue
        names = {t.name for t in best.candidate.terms}
        if best.log_bayes_factor - sum(state.need(n, places) for n in names) > least:
            say(f"{best.candidate.label} instead of {name}")
            state.exchange(places, best)
            return True
    return False
