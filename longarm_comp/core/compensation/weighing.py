"""The payload, by what drives or a wrist sensor feel of it while the arm rests.

A drive holds what gravity asks of its joint (`joint_load`), and friction hides a part: more coming
from below, less from above.  Payload, friction of every channel and one scale of the arm's own
weight are solved together over the rests (least squares with priors).  How large friction is, and
which part of it is alike from rest to rest, is weighed by the evidence of the rests (restricted
likelihood; Patterson and Thompson 1971, Biometrika 58).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.joint_term import joint_load
from longarm_comp.core.model.model import Model

SD = "payload_sd_kg"
"""Column of a context: standard deviation of its `payload_kg`; absent: it is certain."""
_OWN_WEIGHT = 0.1
"""Standard deviation of the arm's own weight against the declared one, as `link_mass` has it."""
_SCALES = np.geomspace(0.25, 4.0, 5)
"""Friction at rest over that of running free, which data sheets give; all alike beforehand."""
_ALIKE = (0.0, 0.25, 0.5, 0.75, 0.95)
"""Share of the variance of friction that is the same at every rest."""
_MOST = 40
"""Rests that are kept: friction changes over a day."""


@dataclass(frozen=True, eq=False)
class Drives:
    """The friction and the steps of joints' efforts, (n,) each, N m and N; NaN: not known."""

    friction: np.ndarray  # of a joint turning free
    step: np.ndarray  # of the reading


class Wrist(NamedTuple):
    """A force sensor's reading (3,) N, in the axes of a row of arm.yaml, and how good it is, N."""

    row: int
    force: np.ndarray
    sigma: float


class Felt(NamedTuple):
    """The loads felt at one rest, (k,) each: of the joints, then of the wrist; N m, N.

    Attributes:
        value: as measured, in the sense of the load; NaN where nothing was.
        without, per_kg: what the arm's statics say, without payload, and of a kilogram.
        side: that friction works on, -1, +1; 0: not known.
        friction, step: as of `Drives`.
    """

    value: np.ndarray
    without: np.ndarray
    per_kg: np.ndarray
    side: np.ndarray
    friction: np.ndarray
    step: np.ndarray

    @property
    def finite(self) -> bool:
        """True where the statics say a number, or none, of every channel."""
        here = ~np.isnan(self.without)
        return bool(np.isfinite([self.without[here], self.per_kg[here]]).all())


def feel_rest(
    model: Model,
    q: np.ndarray,
    context: Context,
    effort: np.ndarray,
    drives: Drives,
    wrist: Wrist | None = None,
) -> Felt:
    """Compare what drives and wrist say at one rest with the arm's statics.

    Args:
        q: (n,) joints, rad and m.
        context: circumstances at q, with the sides of arrival.
        effort: (n,) of the drives, N m and N.
    """

    def loads(kg: float) -> np.ndarray:
        carried = replace(context, columns={**context.columns, "payload_kg": kg})
        at = model.posture(tuple(q.tolist()), carried)
        joints = [joint_load(at, row) for row in model.arm.commanded]
        hand = (np.nan,) * 3 if wrist is None else at.force(at.frame(wrist.row))
        return np.array([*joints, *hand], float)

    declared = model.arm.payload
    heavy = float(context.payload_kg(0.0 if declared is None else declared.mass_kg)) or 1.0
    none, some = loads(0.0), loads(heavy)
    force, sigma = (np.full(3, np.nan), np.nan) if wrist is None else (wrist.force, wrist.sigma)
    sides = np.asarray(context.of_all("approach", model.arm.n), float)
    return Felt(
        value=np.concatenate([-effort, force]),
        without=none,
        per_kg=(some - none) / heavy,
        side=np.concatenate([-sides, np.ones(3)]),
        friction=np.concatenate([drives.friction, np.full(3, sigma)]),
        step=np.concatenate([drives.step, np.zeros(3)]),
    )


@dataclass(frozen=True)
class _FeltPayload:
    """An estimate of the payload, kg, over a number of rests."""

    kg: float
    sigma_kg: float
    rests: int

    def tells(self, reference_kg: float) -> bool:
        """Tell whether it tells such a payload from none; if not, friction hides it."""
        return 2.0 * self.sigma_kg <= reference_kg

    def __str__(self) -> str:
        return f"{self.kg:.3f} kg, give or take {2.0 * self.sigma_kg:.3f}"


@dataclass(frozen=True)
class Weighing:
    """Rests so far. A payload that changed without a word is noticed and weighed anew.

    Attributes:
        run_length: rests between two false alarms, on average.
        rests, loads: what was felt, and a number for each payload that was carried.
        load: number of the present one.
    """

    run_length: float = 1e4
    rests: tuple[Felt, ...] = ()
    loads: tuple[int, ...] = ()
    load: int = 0

    def change_payload(self) -> Weighing:
        """Take it that another payload is carried from now on."""
        return replace(self, load=self.load + 1) if self.load in self.loads else self

    def with_rest(self, rest: Felt) -> Weighing:
        """Take a further rest into account."""
        rests, loads = (*self.rests, rest)[-_MOST:], (*self.loads, self.load)[-_MOST:]
        load = self.load + 1  # of another payload
        if self.load in loads[:-1]:
            (before, now), covariance = _solve(rests, (*loads[:-1], load))
            apart = covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]
            if abs(now - before) > self.limit * np.sqrt(apart):
                return replace(self, rests=rests, load=load, loads=(*loads[:-1], load))
        return replace(self, rests=rests, loads=loads)

    @property
    def limit(self) -> float:
        """Standard deviations beyond which it is no chance."""
        return NormalDist().inv_cdf(1.0 - 0.5 / self.run_length)

    @cached_property
    def payload(self) -> _FeltPayload | None:
        """The present one; None before the first rest with it."""
        if self.load not in self.loads:
            return None
        means, covariance = _solve(self.rests, self.loads)
        sigma = float(np.sqrt(covariance[-1, -1]))
        return _FeltPayload(float(means[-1]), sigma, self.loads.count(self.load))

    def contradicts(self, told_kg: float) -> bool:
        """Tell whether a payload that somebody tells, kg, cannot be what is felt."""
        found = self.payload
        return found is not None and abs(found.kg - told_kg) > self.limit * found.sigma_kg


def _solve(rests: tuple[Felt, ...], loads: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the last two payloads (or the only one), kg: mean and covariance.

    The covariance is infinite where nothing is felt.
    """
    value, without, per_kg, side, friction, step = map(np.array, zip(*rests, strict=True))
    here = np.isfinite(value - without) & (friction > 0)
    numbers = sorted(set(loads))
    which = np.searchsorted(numbers, loads)
    row, channel = np.nonzero(here)
    masses = np.zeros((len(row), len(numbers)))
    masses[np.arange(len(row)), which[row]] = per_kg[here]
    alike_each = np.eye(value.shape[1])[channel] * (side * friction)[here][:, None]
    weight = _OWN_WEIGHT * without[here][:, None]
    y, least = (value - without)[here], step[here] ** 2 / 12.0
    known, count = side[here] != 0, len(numbers)
    scale, alike = (x.reshape(-1, 1) for x in np.meshgrid(_SCALES, _ALIKE))
    alone = np.where(known, 1.0 - alike, 1.0) * (scale * friction[here]) ** 2 + least
    fixed = np.broadcast_to(np.hstack([masses, weight]), (len(scale), len(row), count + 1))
    a = np.concatenate([fixed, (np.sqrt(alike) * scale)[..., None] * alike_each], axis=2)
    white = np.swapaxes(a, 1, 2) / alone[:, None, :]
    h = white @ a + np.diag(np.arange(a.shape[2]) >= count)
    last = slice(max(count - 2, 0), count)
    if (np.linalg.cond(h) * np.finfo(float).eps > 1.0).any():
        size = last.stop - last.start
        return np.zeros(size), np.diag(np.full(size, np.inf))
    b = white @ y
    inverse = np.linalg.inv(h)
    solution = (inverse @ b[..., None])[..., 0]
    log = np.log(alone).sum(axis=1) + np.linalg.slogdet(h)[1]
    log += (y**2 / alone).sum(axis=1) - (b * solution).sum(axis=1)
    share = np.exp(-0.5 * (log - log.min()))
    share /= share.sum()
    mean = share @ solution[:, last]
    apart = solution[:, last] - mean
    inside = inverse[:, last, last] + apart[:, :, None] * apart[:, None, :]
    return mean, np.einsum("g,gij->ij", share, inside)
