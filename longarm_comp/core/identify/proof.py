"""The proof: the models before and after, on poses that no fit has seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import gammaincinv, ndtri

from longarm_comp.core.arm.context import Context
from longarm_comp.core.data.commanded import commanded_errors
from longarm_comp.core.data.measurement import equations, errors, metres, posture, turns
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.calibrate import Errors
from longarm_comp.core.identify.linear import MAD, OUTLIER, median
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.model.model import Model

OFF = 1.5
"""Held-out errors of more than this many times the noise are not noise."""
DECIDES = (4 * ndtri(0.95)) ** 2
"""Gain in squared error, in units of the noise, from which on a real effect of the fitted size
would pass a 95 % test 95 times in 100: the gain scatters by twice its root."""
AGAINST = np.log(20.0)
"""Log odds against the effects from which on such a hold-out withdraws them all the same."""
FEW_LEVELS = 12
"""A joint that was fitted at no more positions stood on a grid."""
ENOUGH_OFF = 10
"""Held-out rows off the levels of a grid, at least, that a network is proven on."""
NETWORK = "with_network"
"""Name of the stage with a learned correction on top of the model."""
RESAMPLES = 2000
BLOCKS = 20


class LearnedError(Protocol):
    """What a learned correction expects: (N, 3) errors in m, and where it may be trusted."""

    @property
    def error(self) -> np.ndarray: ...

    @property
    def in_domain(self) -> np.ndarray: ...


class LearnedCorrection(Protocol):
    """A learned correction of what a model leaves, as `core.learn` makes one."""

    def predict(self, q: np.ndarray, context: Context | None = None) -> LearnedError: ...


@dataclass(frozen=True)
class Proof:
    """Held-out errors of every model, and whether adding the effects helped.

    Attributes:
        errors: by model name, (M, 3) measured - predicted of the rows that say where the tip is,
            m (`core/data/measurement.py`).
        commanded: the same as a command would have them (`core/data/commanded.py`).
        turned: by model name, (K, 3) of the rows that say how the tip is turned, rad.
        better: whether the effects lowered the held-out squared error, each axis in units of its
            noise, beyond chance (95 %, one-sided). Where the hold-out is too small to show effects
            of their size: whether it does not speak against them by odds of 20.
        misfit: median held-out error of the final model over what noise and the fit's own
            uncertainty would give.
        excess_m: its RMS beyond the noise, outliers clipped, m.
        share: of the squared held-out error beyond the noise, what the effects took.
        off_levels: (M,) rows off the levels that the fitted rows have (`off_levels`).
        set_aside: number of held-out rows that the models miss both with and without effects; they
            do not count for `better`.
        log_odds: for the effects, by the rows that count; no row says more than `AGAINST` for them.
    """

    errors: Mapping[str, np.ndarray]
    commanded: Mapping[str, np.ndarray]
    turned: Mapping[str, np.ndarray]
    better: bool
    misfit: float
    excess_m: float
    share: float
    set_aside: int = 0
    log_odds: float = 0.0
    off_levels: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, bool))

    @property
    def rows(self) -> dict[str, Errors]:
        """Figures of `errors` by model name."""
        return {name: Errors.of(error, self.turned[name]) for name, error in self.errors.items()}

    @property
    def agrees(self) -> bool:
        """Whether the hold-out does not speak against the effects by odds of 20."""
        return bool(self.log_odds > -AGAINST)

    @property
    def off(self) -> bool:
        """Whether held-out poses err by much more than the noise, whatever the fit says."""
        return self.misfit > OFF

    def with_network(self, model: Model, network: LearnedCorrection | None, rows: Session) -> Proof:
        """With the errors that a network on top of a model leaves; inside its domain only."""
        if network is None:
            return self
        rows = rows.take(rows.placed)
        expected = network.predict(rows.q, rows.context())
        known = expected.in_domain & rows.located
        learned = np.where(known[:, None], expected.error, 0.0)
        return dataclasses.replace(
            self,
            errors={**self.errors, NETWORK: errors(model, rows) - learned},
            commanded={**self.commanded, NETWORK: commanded_errors(model, rows) - learned},
            turned={**self.turned, NETWORK: turns(model, rows)},
        )

    def network_helps(self, beside: str) -> bool:
        """Whether the network's mean error is below that of a model without it, beyond chance.

        Paired block bootstrap: 95 %, one-sided. On the levels of a grid a network may be right and
        between them anywhere: it must have been asked between them, and help there.
        """
        between = self.off_levels
        if NETWORK not in self.errors or between.sum() < ENOUGH_OFF:
            return False
        without, learned = (np.linalg.norm(self.errors[k], axis=1) for k in (beside, NETWORK))
        if learned[between].mean() >= without[between].mean():
            return False
        drawn = block_means(without - learned, np.random.default_rng(0))
        return bool(np.percentile(drawn, 5.0) > 0)


def prove(
    models: Mapping[str, Model],
    calibrated: ModelFit,
    with_effects: ModelFit,
    rows: Session,
    rng: np.random.Generator,
) -> Proof:
    """Errors, a paired block bootstrap of their difference, and the hold-out against the noise.

    Args:
        models: by name, in the order of the ladder; `calibrated` and `with_effects` among them.
        calibrated: the fit without effects.
        with_effects: the fit with them.
        rows: the hold-out, in time order, all rows seen.
        rng: for the bootstrap.
    """
    left = {name: errors(model, rows) for name, model in models.items()}
    unseen = {
        "calibrated": _Unseen.of(calibrated, rows),
        "with_effects": _Unseen.of(with_effects, rows),
    }
    kept = ~(unseen["calibrated"].missed & unseen["with_effects"].missed)
    asked = unseen["calibrated"].take(kept), unseen["with_effects"].take(kept)
    better = _better(*asked, rng)
    misfit = {name: _misfit(one) for name, one in unseen.items()}
    final = misfit["with_effects" if better else "calibrated"]
    share = 1.0 - (misfit["with_effects"][1] / max(misfit["calibrated"][1], 1e-12)) ** 2
    return Proof(
        left,
        {name: commanded_errors(model, rows) for name, model in models.items()},
        {name: turns(model, rows) for name, model in models.items()},
        better,
        *final,
        share,
        int((~kept).sum()),
        _log_odds(*asked),
        off_levels(with_effects.session.q, rows.take(rows.placed).q),
    )


def off_levels(fitted: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(M,) which rows have a joint between the few levels that it was fitted at; all without such.

    Args:
        fitted: (N, n) commanded joints of the fitted rows.
        q: (M, n) of the rows in question.
    """
    off, grid = np.zeros(len(q), bool), False
    for seen, asked in zip(fitted.T, q.T, strict=True):
        span = float(np.ptp(seen))
        levels = np.unique(np.round(seen / (span or 1.0), 2)) * span
        if 1 < len(levels) <= FEW_LEVELS:
            grid = True
            away = np.abs(asked[:, None] - levels).min(axis=1)
            off |= away > 0.25 * np.diff(levels).min()
    return off if grid else np.ones(len(q), bool)


@dataclass(frozen=True)
class _Unseen:
    """Unseen rows against a fit.

    Attributes:
        residual: (N, d) measured - predicted, m or rad; 0 where a channel was not measured, or is
            unknown to the fit.
        spread: (N, d) standard deviation that noise and parameter uncertainty give it.
        held: (N, d) which channels count.
        metres: (d,) length (m) that a unit of each channel stands for.
    """

    residual: np.ndarray
    spread: np.ndarray
    held: np.ndarray
    metres: np.ndarray

    @classmethod
    def of(cls, fitted: ModelFit, rows: Session) -> _Unseen:
        found = equations(fitted.model, rows, posture(fitted.model, rows))
        known = dict(zip(fitted.session.channels, fitted.sigma, strict=True))
        sigma = np.array([known.get(name, np.inf) for name in rows.channels])
        own = np.einsum(
            "nip,pq,niq->ni", found.columns, fitted.covariance, found.columns, optimize=True
        )
        held = rows.measured & np.isfinite(sigma)
        noise = np.where(np.isfinite(sigma), sigma, 1.0) * fitted.uneven(rows)[:, None]
        spread = np.sqrt(noise**2 + own)
        return cls(found.residual * held, spread, held, metres(fitted.model, rows))

    def take(self, rows: np.ndarray) -> _Unseen:
        """Some of the rows."""
        return dataclasses.replace(
            self, residual=self.residual[rows], spread=self.spread[rows], held=self.held[rows]
        )

    @property
    def missed(self) -> np.ndarray:
        """(N,) rows that are outliers beside what the model leaves of the other rows."""
        white = np.abs(self.residual) / self.spread
        usual = MAD * median(np.where(self.held, white, np.nan))
        return np.asarray((white > OUTLIER * np.maximum(usual, 1.0)).any(axis=1))


def _better(before: _Unseen, after: _Unseen, rng: np.random.Generator) -> bool:
    """Whether the squared errors, in units of the noise, fell beyond chance (95 %, one-sided).

    Where so few poses could not show an effect of the fitted size, though it be real, it is the
    evidence of the fitted rows that counts, unless the hold-out speaks against the effects by odds
    of 20. The log odds are half the gain.
    """
    gain = _gain(before, after)
    expected = float((((before.residual - after.residual) / after.spread) ** 2).sum())
    if expected < DECIDES:
        return bool(gain.sum() / 2 > -AGAINST)
    return bool(np.percentile(block_means(gain, rng), 5.0) > 0)


def _gain(before: _Unseen, after: _Unseen) -> np.ndarray:
    """(N,) by how much each row's squared error fell, in units of the noise."""
    gain = (before.residual**2 - after.residual**2) / after.spread**2
    return np.asarray(gain.sum(axis=1))


def _log_odds(before: _Unseen, after: _Unseen) -> float:
    """For the effects: half the gain. One row may speak for them by odds of 20 at most."""
    return float(np.minimum(_gain(before, after) / 2, AGAINST).sum())


def _misfit(unseen: _Unseen) -> tuple[float, float]:
    """Median error over the expected (chi), and the clipped RMS of lengths beyond it (m)."""
    degrees = unseen.held.sum(axis=1)
    some = degrees > 0
    size = np.linalg.norm(unseen.residual / unseen.spread, axis=1)[some]
    expected = np.sqrt(2.0 * gammaincinv(degrees[some] / 2, 0.5))
    ratio = float(np.median(size / expected))
    error = np.linalg.norm(unseen.residual * unseen.metres, axis=1)
    limit = 3.0 * np.median(error)
    clipped = np.minimum(error, limit)
    noise = ((unseen.spread * unseen.metres) ** 2 * unseen.held).sum(1).mean()
    return ratio, float(np.sqrt(max((clipped**2).mean() - noise, 0.0)))


def block_means(gain: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Means of (M,) over successive blocks drawn with replacement, (RESAMPLES,)."""
    blocks = np.array_split(gain, min(BLOCKS, len(gain)))
    sums = np.array([b.sum() for b in blocks])
    sizes = np.array([len(b) for b in blocks])
    drawn = rng.integers(len(blocks), size=(RESAMPLES, len(blocks)))
    return sums[drawn].sum(1) / sizes[drawn].sum(1)
