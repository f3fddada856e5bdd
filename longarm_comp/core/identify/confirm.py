"""Confirm: does a finding survive resampled blocks, other priors, more noise?"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from scipy.special import ndtri

from longarm_comp.core.identify.aliasing import EffectFinding
from longarm_comp.core.identify.candidates import Candidate, CandidateColumns, Term
from longarm_comp.core.identify.confounded import confounded
from longarm_comp.core.identify.evidence import columns_at, key, neighbours
from longarm_comp.core.identify.linear import Posterior
from longarm_comp.core.identify.model_fit import ModelFit, priors
from longarm_comp.core.identify.search import SearchResult

RESAMPLES = 300
BLOCKS = 30
LOOSE = 3.0
"""Times a found value that its prior must reach, so that it hardly pulls at the interval."""
TOUCHES = 0.05
"""Share of an interval within which a value is at its bound."""
HOLDS = 3.0
"""Log Bayes factor above which evidence holds, of a resample or under other assumptions."""
SHARED = 0.5
"""Two findings that lose more of their evidence beside each other than this overlap."""


@dataclass(frozen=True)
class Interval:
    """A parameter with its 95 % interval: the wider of Laplace and block bootstrap (SI).

    Attributes:
        at_bound: the value is at a bound of the parameter, as far as the interval can tell: it is
            no estimate, and only the other end of the interval says something.
    """

    value: float
    low: float
    high: float
    at_bound: bool = False


@dataclass(frozen=True)
class Overlap:
    """Two findings of which either alone would take most of what is the other's.

    Attributes:
        names: the two effects.
        shares: of each one's evidence without the other, what is lost beside the other.
    """

    names: tuple[str, str]
    shares: tuple[float, float]


@dataclass(frozen=True)
class Confirmed:
    """What resampling says.

    Attributes:
        intervals: by position in the fit's slots.
        stable: by effect, share of resamples in which its evidence stays above `HOLDS`.
        notes: by effect, what to doubt, in words.
        overlaps: pairs of effects that explain much of the same.
    """

    intervals: dict[int, Interval]
    stable: dict[str, float]
    notes: dict[str, tuple[str, ...]]
    overlaps: tuple[Overlap, ...] = ()


def confirm(
    result: SearchResult,
    found: list[EffectFinding],
    candidates: Sequence[Candidate],
    rng: np.random.Generator,
) -> Confirmed:
    """Block bootstrap of the final linear problem, and its stability under doubt."""
    fit = result.fit
    blocks = len(_block_rows(len(fit.design), fit.width))
    counts = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=RESAMPLES)
    index = {
        f.name: np.array(
            [k for k, s in enumerate(fit.slots) if key(s.owner) in set(map(key, f.terms))],
            dtype=int,
        )
        for f in found
    }
    stable = _stability(fit, found, index, counts)
    notes = {f.name: _doubts(fit, f, index[f.name], stable[f.name]) for f in found}
    return Confirmed(
        _intervals(fit, found, candidates, counts), stable, notes, _overlaps(fit, index)
    )


def _intervals(
    fit: ModelFit,
    found: Sequence[EffectFinding],
    candidates: Sequence[Candidate],
    counts: np.ndarray,
) -> dict[int, Interval]:
    """By position in the fit's slots; counts (R, B): how often each block is drawn.

    What could have come out otherwise is put beside the fitted parameters with its priors
    (`nuisance_columns`).
    """
    wider = _wider(fit, found)
    design = np.concatenate([fit.design * wider, nuisance_columns(fit, found, candidates)], axis=1)
    gram, right = _blocks(design, fit.data, fit.width)
    prior_gram = np.eye(design.shape[1])
    draws = np.array(
        [
            np.linalg.solve(np.tensordot(count, gram, axes=1) + prior_gram, count @ right)
            for count in counts
        ]
    )
    inverse = np.linalg.inv(gram.sum(0) + prior_gram)
    kept = slice(len(fit.slots))
    scale = priors(fit.slots) * wider
    centre = (inverse @ right.sum(0))[kept] * scale
    sd = np.maximum(draws.std(axis=0), np.sqrt(np.diag(inverse)))[kept] * scale
    half = ndtri(0.975) * sd
    made = {}
    for k, (slot, value) in enumerate(zip(fit.slots, fit.model.values, strict=True)):
        low, high = min(centre[k] - half[k], value), max(centre[k] + half[k], value)
        bounds = slot.parameter
        low, high = max(float(low), bounds.lower), min(float(high), bounds.upper)
        room = min(float(value) - bounds.lower, bounds.upper - float(value))
        made[k] = Interval(float(value), low, high, room <= TOUCHES * (high - low))
    return made


def _stability(
    fit: ModelFit, found: Sequence[EffectFinding], index: dict[str, np.ndarray], counts: np.ndarray
) -> dict[str, float]:
    """By effect, share of the resamples in which its evidence stays."""
    gram, right = _blocks(fit.design, fit.data, fit.width)
    whole = {f.name: _block_gains(fit, f) for f in found if not len(index[f.name])}
    tests: dict[str, list[float]] = {f.name: [] for f in found}
    for count in counts:
        solved = Posterior.of(np.tensordot(count, gram, axes=1), count @ right)
        for name, own in index.items():
            tests[name].append(solved.evidence(own) if len(own) else float(count @ whole[name]))
    return {name: float((np.array(values) > HOLDS).mean()) for name, values in tests.items()}


def _wider(fit: ModelFit, found: Sequence[EffectFinding]) -> np.ndarray:
    """(p,) how much wider the prior of a found parameter must be not to pull at its value.

    That it is there has been decided; how large it is, the data say.
    """
    mine = {key(t) for f in found for t in f.terms}
    sizes = [
        abs(value) / slot.parameter.prior if key(slot.owner) in mine else 0.0
        for value, slot in zip(fit.model.values, fit.slots, strict=True)
    ]
    return np.maximum(1.0, LOOSE * np.array(sizes))


def _overlaps(fit: ModelFit, index: dict[str, np.ndarray]) -> tuple[Overlap, ...]:
    """Pairs whose evidence beside each other is less than `SHARED` of what each has alone."""
    gram, right = fit.gram, fit.design.T @ fit.data
    whole, made = Posterior.of(gram, right), []
    for one, two in combinations([name for name, own in index.items() if len(own)], 2):
        shares = []
        for name, other in ((one, two), (two, one)):
            kept = np.setdiff1d(np.arange(len(right)), index[other])
            own = np.searchsorted(kept, index[name])
            alone = Posterior.of(gram[np.ix_(kept, kept)], right[kept]).evidence(own)
            shares.append(1.0 - whole.evidence(index[name]) / max(alone, 1e-9))
        if min(shares) > SHARED:
            made.append(Overlap((one, two), (shares[0], shares[1])))
    return tuple(made)


def _blocks(a: np.ndarray, y: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of successive blocks of rows of so many channels: (B, p, p), (B, p)."""
    parts = _block_rows(len(a), width)
    return np.stack([a[s].T @ a[s] for s in parts]), np.stack([a[s].T @ y[s] for s in parts])


def _block_gains(fit: ModelFit, found: EffectFinding) -> np.ndarray:
    """(B,) gain in log likelihood by block of an effect that has nothing to fit."""
    shift = columns_at(fit).shift(found.terms)
    white = fit.whitened(shift[..., None])[:, 0]
    left = fit.whitened(fit.residual[..., None])[:, 0]
    gain = left * white + 0.5 * white * white
    return np.array([gain[s].sum() for s in _block_rows(len(gain), fit.width)])


def _block_rows(equations: int, width: int) -> list[slice]:
    rows = equations // width
    cuts = np.linspace(0, rows, min(BLOCKS, rows) + 1).astype(int) * width
    return [slice(lo, hi) for lo, hi in pairwise(cuts)]


def _doubts(fit: ModelFit, found: EffectFinding, own: np.ndarray, stable: float) -> tuple[str, ...]:
    """What a sceptic would say."""
    said = [f"{part.name} could stand for its {part.part}" for part in found.partial_aliases]
    said += [p.sentence for p in confounded(fit.session, fit.model.arm, found.terms)]
    if stable < 0.95:
        said.append(f"its evidence holds in {100 * stable:.0f} % of resampled sessions only")
    if not len(own):
        return tuple(said)
    gram, right = fit.gram, fit.design.T @ fit.data
    louder = 1.5
    if Posterior.of(gram / louder**2, right / louder**2).evidence(own) < HOLDS:
        said.append(f"it would not be found with {louder} times the noise")
    for factor, words in ((25.0, "five times wider"), (1 / 25.0, "five times narrower")):
        scale = np.ones(len(right))
        scale[own] = np.sqrt(factor)
        if Posterior.of(gram * np.outer(scale, scale), right * scale).evidence(own) < HOLDS:
            said.append(f"it would not be found with priors {words}")
    for k in own:
        value, p = fit.model.values[k], fit.slots[k].parameter
        if abs(value) > 5 * p.prior:
            said.append(f"{fit.slots[k].label} = {value:.3g} {p.unit} is implausibly large")
    return tuple(said)


STEP = 0.05
"""Of the width between the neighbouring tried values: step of a form's slope."""


def nuisance_columns(
    fit: ModelFit, found: Sequence[EffectFinding], candidates: Sequence[Candidate]
) -> np.ndarray:
    """(dM, k) whitened, prior-scaled columns."""
    columns = columns_at(fit)
    other = {**_dropped(fit, found, candidates), **_standing_in(found)}
    made = [columns.of(tuple(other.values()))]
    made += _slopes(fit, columns, [t for f in found for t in f.terms], candidates)
    return fit.whitened(np.concatenate(made, axis=-1))


def _dropped(
    fit: ModelFit, found: Sequence[EffectFinding], candidates: Sequence[Candidate]
) -> dict[tuple[str, str], Term]:
    """A found effect's other places, in its form where there is one."""
    held = {key(t) for t in fit.model.terms}
    missing: dict[tuple[str, str], Term] = {}
    for finding in found:
        form = Candidate(finding.name, finding.terms).form
        mine = [c for c in candidates if c.name == finding.name]
        for candidate in sorted(mine, key=lambda c: c.form != form):
            missing = {key(t): t for t in candidate.terms if key(t) not in held} | missing
    return missing


def _standing_in(found: Sequence[EffectFinding]) -> dict[tuple[str, str], Term]:
    """Effects that may well be there instead of a part of a finding."""
    rivals = [part.score.candidate for f in found for part in f.partial_aliases if part.rival]
    return {key(t): t for rival in rivals for t in rival.terms}


def _slopes(
    fit: ModelFit, columns: CandidateColumns, terms: Sequence[Term], candidates: Sequence[Candidate]
) -> list[np.ndarray]:
    """(N, d, 1) change of the rows as each scale moves half way to the next tried value."""
    ways: list[tuple[Term, Term, float]] = []
    for term in terms:
        for field in term.scales():
            low, high = neighbours(term, field, candidates)
            here = float(getattr(term, field))
            step = STEP if here < 0.5 * (low + high) else -STEP
            moved = dataclasses.replace(term, **{field: here + step * (high - low)})
            ways.append((term, moved, 0.5 / step))
    columns.of([t for term, moved, _ in ways for t in (term, moved)])  # all at once: much faster
    made = []
    for term, moved, times in ways:
        values = [
            v / slot.parameter.prior
            for v, slot in zip(fit.model.values, fit.slots, strict=True)
            if key(slot.owner) == key(term)
        ]
        change = (columns.of([moved]) - columns.of([term])) @ np.array(values)
        made.append(times * change[..., None])
    return made
