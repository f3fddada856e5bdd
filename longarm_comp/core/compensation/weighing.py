"""The payload, estimated from drive efforts or a wrist force sensor while the arm rests.

The effort of a drive holds the gravity load of its joint (`joint_load`), plus or minus friction:
more if the joint came from below, less from above.  Payload, friction of every channel and one
scale of the arm's own weight are solved together over the rests (least squares with priors).  How
large friction is, and which part of it is the same at every rest, follows from the evidence of the
rests (restricted likelihood; Patterson and Thompson 1971, Biometrika 58).
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
"""Column of a context: standard deviation of its `payload_kg`; without it this is certain."""
_OWN_WEIGHT = 0.1
"""Standard deviation of the arm's own weight, as a share of the declared one (see `link_mass`)."""
_SCALES = np.geomspace(0.25, 4.0, 5)
"""Possible ratios of friction at rest to friction of running free (of data sheets), equally
likely."""
_ALIKE = (0.0, 0.25, 0.5, 0.75, 0.95)
"""Possible shares of the variance of friction that are the same at every rest, equally likely."""
_MOST = 40
"""Number of the last rests that are kept, because friction changes over a day."""


@dataclass(frozen=True, eq=False)
class Drives:
    """Friction and resolution of the drives' efforts, (n,) each, N m and N; NaN: not known."""

    friction: np.ndarray  # of a joint running free
    step: np.ndarray  # smallest step of the effort reading


class Wrist(NamedTuple):
    """The reading of a force sensor at the wrist."""

    row: int  # the row of arm.yaml in whose axes it reads
    force: np.ndarray  # (3,) N
    sigma: float  # standard deviation of each axis, N


class Felt(NamedTuple):
    """The loads at one rest, measured and computed.

    Each is (k,) with k = n + 3, N m and N: of the n joints, then of the three axes of the wrist.
    """

    value: np.ndarray  # measured load, with the sign of the load; NaN where not measured
    without: np.ndarray  # load by the arm's statics without payload
    per_kg: np.ndarray  # load by the statics of a payload of 1 kg
    side: np.ndarray  # sign of the friction in `value`, -1 or +1; 0: not known. +1 at the wrist.
    friction: np.ndarray  # friction of the joints as in `Drives`; at the wrist, standard deviation
    step: np.ndarray  # smallest step of the reading as in `Drives`; 0 at the wrist

    @property
    def measured(self) -> bool:
        """True if a load was measured on a channel whose friction is known."""
        return bool((np.isfinite(self.value - self.without) & (self.friction > 0)).any())

    @property
    def finite(self) -> bool:
        """True if the computed load and load per kg are finite on every channel that has one."""
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
    """Return the loads measured at one rest, with those of the arm's statics.

    Args:
        q: (n,) joints, rad and m.
        context: circumstances at q, with the sides of arrival.
        effort: (n,) efforts of the drives, N m and N; NaN: not measured.
        drives: friction and resolution of these.
        wrist: reading of a force sensor, if there is one.
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
    """An estimate of the payload and its standard deviation, kg, and the number of its rests."""

    kg: float
    sigma_kg: float
    rests: int

    def tells(self, reference_kg: float) -> bool:
        """Tell whether it is exact enough to tell a payload of `reference_kg` from none."""
        return 2.0 * self.sigma_kg <= reference_kg

    def __str__(self) -> str:
        return f"{self.kg:.3f} kg, give or take {2.0 * self.sigma_kg:.3f}"


@dataclass(frozen=True)
class Weighing:
    """The weighing of the payload over the last rests.

    It notices by itself when the payload changes, and then weighs the new one.
    """

    run_length: float = 1e4  # mean number of rests between two false alarms of a change
    rests: tuple[Felt, ...] = ()  # the loads at each rest
    loads: tuple[int, ...] = ()  # for each rest the number of the payload that was carried
    load: int = 0  # number of the present payload

    def change_payload(self) -> Weighing:
        """Return the weighing that begins anew, because another payload is carried from now on."""
        return replace(self, load=self.load + 1) if self.load in self.loads else self

    def with_rest(self, rest: Felt) -> Weighing:
        """Return the weighing with one more rest."""
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
        """Number of standard deviations beyond which a difference is not by chance."""
        return NormalDist().inv_cdf(1.0 - 0.5 / self.run_length)

    @cached_property
    def payload(self) -> _FeltPayload | None:
        """The estimate of the present payload; None before the first rest with it."""
        if self.load not in self.loads:
            return None
        means, covariance = _solve(self.rests, self.loads)
        sigma = float(np.sqrt(covariance[-1, -1]))
        return _FeltPayload(float(means[-1]), sigma, self.loads.count(self.load))

    def contradicts(self, told_kg: float) -> bool:
        """Tell whether a stated payload, kg, is too far from the estimate to be true."""
        found = self.payload
        return found is not None and abs(found.kg - told_kg) > self.limit * found.sigma_kg


def _solve(rests: tuple[Felt, ...], loads: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the last two payloads (or the only one), kg: mean (2,) and covariance (2, 2).

    The covariance is infinite if the rests do not determine the payloads.
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
