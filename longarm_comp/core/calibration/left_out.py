"""The errors of a fit at rows that are left out of it, and the error of commands that follows.

Each part of the rows is left out in turn, and the error is computed from the design: no fit is
repeated.  Rows that the fit set aside are left out by themselves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.calibration.model_fit import ModelFit, choose_evenly, prior_widths
from longarm_comp.core.data.set_aside import chance_of_arm
from longarm_comp.core.model.uncertainty import LEVEL, sizes

PARTS, SMALL = 4, 20
"""Number of parts of each joint's range, and number of random parts of the rows, that are left out
in turn."""
MOST = 1000
"""Largest number of rows, evenly over the session, whose errors are computed.

They determine the 90 % level to one percent.
"""
AMID = (1.0 + LEVEL) / 2.0
"""Largest fraction of the rows left out at random that may lie inside the stated radius: halfway
from `LEVEL` to 1.

It is above `LEVEL` because the model was chosen on these rows, and so has larger errors at others.
With `LEVEL` itself, 55 % of WAM's test rows are inside instead of 80 %.
"""
HALVINGS = 30
"""Number of bisections of a range: to nine digits."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """The errors of rows that are left out of a fit. Each row occurs several times among the M.

    Attributes:
        error: (M, 3) measured - predicted by a fit without the row, m.
        covariance: (M, 3, 3) covariance of this prediction by the fitted parameters, m^2.
        count: (M,) weight of each; the weights of one row sum up to 1, or to the probability that
            the arm was there, if the fit set it aside.
        amid: (M,) True if similar rows stayed in the fit (random parts), False if a whole part of
            a joint's range, or of the touched places, was left out.
        believed: (M,) False for a row that the fit set aside.
    """

    error: np.ndarray
    covariance: np.ndarray
    count: np.ndarray
    amid: np.ndarray
    believed: np.ndarray

    @classmethod
    def of(cls, fit: ModelFit, anew: np.ndarray | None = None) -> LeftOut | None:
        """Leave rows out of a fit to positions or touches; None if fewer than two rows have one.

        The place of a touched point is not known, so its rows are compared with their mean.

        Args:
            fit: the fit.
            anew: (N, 3) errors of the rows, m, by models that were chosen and fitted without them,
                which replace those by the design amid the other rows, but for touches; NaN: there
                is none.
        """
        kept = np.flatnonzero((fit.weights > 0) & fit.has_point)
        if len(kept) < 2:
            return None
        touched = fit.session.labels["touch"][kept] if not fit.session.has_position.any() else None
        white = fit.whiten_with_residual(fit.sigma)
        whole = white.reshape((fit.weights > 0).sum(), fit.width, -1)
        here = np.searchsorted(np.flatnonzero(fit.weights > 0), kept)
        gram = np.einsum("ncp,ncq->pq", whole[..., :-1], whole[..., :-1])
        gram += np.eye(len(gram))
        length = fit.sigma[:3] / np.sqrt(fit.weights[kept])[:, None]
        judged = choose_evenly(np.arange(len(kept)), MOST)
        q = fit.session.q[kept]
        made = []
        places = None
        if touched is not None:  # points at known distances belong to one tool: one place
            places = touched.copy()
            for first, second, *_ in fit.session.touch_distances:
                places[places == second] = first
        for division, share, near in _divide_rows(q, places):
            for part in np.unique(division):
                out = division == part
                a = whole[here[out]]
                flat = a.reshape(-1, a.shape[-1])
                inverse = np.linalg.inv(gram - flat[:, :-1].T @ flat[:, :-1])
                shift = inverse @ (flat[:, :-1].T @ flat[:, -1])
                rows = a[:, :3] * length[out][..., None]
                mine = np.isin(np.flatnonzero(out), judged)
                if touched is not None:
                    rows, alone = subtract_point_means(rows, touched[out])
                    mine &= ~alone
                moved = rows[mine, :, :-1]
                error = rows[mine, :, -1] + moved @ shift
                if near and anew is not None and touched is None:
                    proved = anew[kept[np.flatnonzero(out)[mine]]]
                    error = np.where(np.isnan(proved), error, proved)
                carried = moved @ inverse @ np.swapaxes(moved, 1, 2)
                alike = (np.full(len(error), each) for each in (share, near, True))
                made.append((error, carried, *alike))
        if touched is None:
            aside = np.flatnonzero((fit.weights == 0) & fit.has_point)
            moved = fit.columns[aside][:, :3] * prior_widths(fit.slots)
            carried = moved @ np.linalg.inv(gram) @ np.swapaxes(moved, 1, 2)
            count = chance_of_arm(fit.session, fit.weights == 0)[aside]
            no = np.zeros(len(aside), bool)
            made.append((fit.residual[aside][:, :3], carried, count, no, no))
        return cls(*map(np.concatenate, zip(*made, strict=True)))

    def find_least_errors(self, noise: np.ndarray) -> tuple[float, np.ndarray]:
        """Find the smallest stated errors that contain 90 % of the rows that were left out.

        They are enlarged in two ways.  One is a further covariance, the same everywhere, for errors
        that no parameter explains.  It is too large if more than `AMID` of the rows that were left
        out at random lie inside the stated errors.  Then the covariance of the parameters is
        multiplied by the number of rows that count as one, as similar rows have similar errors.

        Args:
            noise: (3, 3) covariance of the measurement, m^2.

        Returns:
            The number of rows that count as one, and the further covariance (3, 3) amid the rows,
            m^2.
        """
        amid = self.amid if self.amid.any() else self.believed
        every, best = np.linalg.norm(self.error, axis=1), math.inf
        size, largest = every[amid], float(every[amid | ~self.believed].max())
        counts = 2.0 ** np.arange(0.0, math.log2(len(self.error)) + 1.0, 0.5)
        alike, structure = float(counts[-1]), largest**2 / 3.0 * np.eye(3)  # at worst
        for count in counts:
            further = self._find_structure(noise, count, largest)
            if further is None:  # more than any row amid the others errs
                continue
            radius = sizes(count * self.covariance[amid] + noise + further)[1]
            if np.median(radius) < best:
                best, alike, structure = float(np.median(radius)), float(count), further
            if (size <= radius).mean() <= AMID or not further.any():
                break
        return alike, structure

    def _find_structure(self, noise: np.ndarray, alike: float, largest: float) -> np.ndarray | None:
        """Return the smallest further covariance (3, 3), m^2, with which enough rows lie inside.

        Enough are 90 % of the rows, inside the stated radius. The covariance is proportional to the
        weighted mean of the products ``error error'`` of believed rows.

        Args:
            noise: (3, 3) covariance of the measurement, m^2.
            alike: the number of rows that count as one.
            largest: largest square root of its trace, m; None is returned if this is not enough.
        """
        shape = np.einsum("n,ni,nj->ij", self.count * self.believed, self.error, self.error)
        shape /= np.trace(shape) or 1.0
        size = np.linalg.norm(self.error, axis=1)
        wanted = LEVEL * (self.count.sum() + 1.0)

        def holds_enough(square: float) -> bool:
            inside = size <= sizes(alike * self.covariance + noise + square * shape)[1]
            return bool(self.count @ inside >= wanted)

        low, high = 0.0, largest**2
        if holds_enough(low) or not holds_enough(high):
            return 0.0 * shape if holds_enough(low) else None
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if holds_enough(middle) else (middle, high)
        return high * shape


def subtract_point_means(rows: np.ndarray, touched: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Subtract from each row (N, ...) the mean of the rows that touched the same point.

    The differences are scaled so that independent noise keeps its variance.

    Args:
        touched: (N,) name of each row's point.

    Returns:
        The scaled differences, and (N,) True for a row that alone touched its point.
    """
    _, which, count = np.unique(touched, return_inverse=True, return_counts=True)
    sums = np.zeros((len(count), *rows.shape[1:]))
    np.add.at(sums, which, rows)
    beside = (...,) + (None,) * (rows.ndim - 1)
    kept = np.maximum(1.0 - 1.0 / count, 0.5)[which][beside]
    return (rows - (sums / count[beside])[which]) / np.sqrt(kept), count[which] == 1


def _divide_rows(
    q: np.ndarray, places: np.ndarray | None = None
) -> Iterator[tuple[np.ndarray, float, bool]]:
    """Yield divisions of the rows into parts that are left out.

    Half of the weight is on parts of the joints' ranges, half on random parts, because targets are
    at new and at known places.  If several points were touched, each of them is a part instead:
    `places` (N,) then holds their names.

    Yields:
        The number (N,) of each row's part, the weight of a row in this division, and whether the
        parts are random, so that similar rows stay.
    """
    if places is not None and len(np.unique(places)) > 1:
        yield np.unique(places, return_inverse=True)[1], 1.0, False
        return
    moving = [q[:, j] for j in range(q.shape[1]) if np.ptp(q[:, j]) > 0.0]
    for values in moving:
        place = np.argsort(np.argsort(values, kind="stable"))
        yield place * PARTS // len(q), 0.5 / len(moving), False
    drawn = np.random.default_rng(0).permutation(len(q))
    yield drawn * min(SMALL, len(q)) // len(q), 0.5 if moving else 1.0, True
