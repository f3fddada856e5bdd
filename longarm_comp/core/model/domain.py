"""Computes how an error grows away from the joints at which the rows of a fit stand.

What no parameter explains is taken for a smooth function of the joints: a Gaussian process, known
at the rows (kriging; Matheron 1963, Econ. Geol. 58).  Its variance is small amid the rows, and
grows with the distance from them: beside a line of rows, in a hole, beyond a range.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.arm import Arm

LEAST_MOVED = 0.1
"""Share of its range by which a joint must move in the rows, so that they show how the error varies
with this joint."""
SMOOTH = 1.0
"""Correlation length of the error, in ranges of the rows.

Errors of gears, encoders and beams turn once or twice over a joint's range. With 1.5 the promise
beside a band of rows holds 72 to 100 % instead of 96 to 100 %.
"""
ROUGH = 1e-4
"""Variance of the error that no other row tells, as a share of the process's variance.

With ten times as much the promise beside a band of rows holds 57 to 100 % instead of 96 to 100 %.
"""
MOST = 100
"""Largest number of rows that stand for all: those farthest apart."""


def least_moved(arm: Arm) -> np.ndarray:
    """Return the range (n,), rad or m, above which a joint's rows show how an error varies."""
    return LEAST_MOVED * (arm.upper - arm.lower)


@dataclass(frozen=True, eq=False)
class RowDomain:
    """The places of a fit's rows in joint space.

    Attributes:
        q: (R, n) joints of rows far apart, rad and m.
        span: (n,) range of each joint in the rows; infinite if it hardly moved, because such rows
            do not tell how an error varies with it.
        amid: usual variance of the process amid the rows, as a share of that far from all.
    """

    q: np.ndarray
    span: np.ndarray
    amid: float

    @classmethod
    def of(cls, q: np.ndarray, least: np.ndarray) -> RowDomain:
        """Make it from the joints (N, n) of a fit's rows.

        Args:
            least: (n,) rad or m; a joint whose range in the rows is not larger hardly moved.
        """
        places = q[choose_apart(q / _span(q, 0.0 * least), MOST)]
        made = cls(places, _span(places, least), 1.0)
        each = 1.0 / (made._whitener**2).sum(axis=0)  # of each place, by all others
        return dataclasses.replace(made, amid=float(np.median(each)))

    def plus(self, q: np.ndarray) -> RowDomain:
        """Return the domain with one more place, joints (n,), unless it is amid the others."""
        if self.growth_at(q[None])[0] <= 1.0:
            return self
        return dataclasses.replace(self, q=np.concatenate([self.q, q[None]]))

    def growth_at(self, q: np.ndarray) -> np.ndarray:
        """Return how an error's variance grows from amid the rows to joints (N, n): (N,), from 1.

        Half of the variance amid the rows is the same everywhere: what they show and no parameter
        explains.  The other half is that of the process, which grows with the distance.
        """
        near = self._alike(q) @ self._whitener.T
        variance = np.maximum(1.0 - (near**2).sum(axis=1), 0.0) + ROUGH
        return np.asarray(np.maximum(0.5 + 0.5 * variance / self.amid, 1.0))

    @cached_property
    def _whitener(self) -> np.ndarray:
        """The inverse (R, R) of a square root of the places' covariance."""
        count = len(self.q)
        return np.linalg.inv(np.linalg.cholesky(self._alike(self.q) + ROUGH * np.eye(count)))

    def _alike(self, q: np.ndarray) -> np.ndarray:
        """Return the correlation (N, R) of the error process between joints (N, n) and `self.q`."""
        x, y = q / (SMOOTH * self.span), self.q / (SMOOTH * self.span)
        apart = (x**2).sum(axis=1)[:, None] + (y**2).sum(axis=1) - 2.0 * x @ y.T
        return np.asarray(np.exp(-0.5 * np.maximum(apart, 0.0)))


def choose_apart(x: np.ndarray, most: int) -> np.ndarray:
    """Return the numbers of at most `most` different points of (N, k), farthest apart.

    Each is the farthest from those before it; the first is the nearest to their mean.
    """
    chosen = [int(((x - x.mean(axis=0)) ** 2).sum(axis=1).argmin())]
    away = ((x - x[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < most and away.max() > 0.0:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, ((x - x[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)


def _span(q: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Return the range of each joint over rows (N, n); infinite if it is not above `least`."""
    span = np.ptp(q, axis=0)
    return np.asarray(np.where(span > least, span, np.inf))
