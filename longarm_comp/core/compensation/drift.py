"""A sequential test of the residual: does the arm still behave as its model predicts?

Every rest pose gives one standardised residual ``z = (measured - predicted) / sigma`` (3,), which
is standard normal while model and sigma are right. Seven Page tests (cumulative sums of
log-likelihood ratios, restarted at zero) watch for a shift along each axis in each direction, and
for errors that have grown. With a threshold h, the mean number of samples to a false alarm of one
test is at least ``exp(h)`` (Lorden 1971, Ann. Math. Stat. 42). So with ``h = ln(7 * run_length)``
the mean number to a false alarm of any of the seven is at least ``run_length``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.core.errors import InputError

_GROWTH = 1.6
"""Factor of growth of the standard deviation for which the test is made."""
_TESTS = ("+x", "-x", "+y", "-y", "+z", "-z", "growth")


@dataclass(frozen=True)
class Verdict:
    """The result of the test after some samples."""

    drifted: bool  # whether the alarm is raised
    finding: str  # size and duration of the change in a sentence; empty without an alarm
    samples: int  # number of samples so far
    evidence: float  # largest cumulative sum divided by the threshold; 1 or more is an alarm


@dataclass(frozen=True)
class Monitor:
    """The state of the test. It never changes: `seen` returns the next state.

    `sums` holds the cumulative sums, in the order of `_TESTS`, `onset` the number of the sample at
    which each last left zero. Since then, `total` is the sum of the residuals, m, and `squares`
    that of ``|z|^2``.
    """

    run_length: float = 1e4  # mean number of samples between two false alarms, at least
    samples: int = 0  # number of samples so far
    sums: np.ndarray = field(default_factory=lambda: np.zeros(len(_TESTS)))
    onset: np.ndarray = field(default_factory=lambda: np.zeros(len(_TESTS), int))
    total: np.ndarray = field(default_factory=lambda: np.zeros((len(_TESTS), 3)))
    squares: np.ndarray = field(default_factory=lambda: np.zeros(len(_TESTS)))

    def __post_init__(self) -> None:
        if not (math.isfinite(self.run_length) and self.run_length > 1):
            raise InputError("monitor", "run_length", self.run_length, "a number above 1")

    @property
    def threshold(self) -> float:
        """The cumulative sum at which a test raises the alarm."""
        return math.log(len(_TESTS) * self.run_length)

    def seen(self, residual: ArrayLike, sigma: ArrayLike) -> Monitor:
        """Return the monitor after one more independent sample.

        Errors of the model that repeat are no independent samples: `RepeatingErrors` follows them.

        Args:
            residual: (3,) m, measured - expected.
            sigma: (3,) m, standard deviations of the residual, of model and measurement; or its
                (3, 3) covariance, m^2.

        Raises:
            InputError: a shape or value is wrong.
        """
        r, s = np.asarray(residual, float), np.asarray(sigma, float)
        if r.shape != (3,) or not np.isfinite(r).all():
            raise InputError("monitor", "residual", residual, "three finite numbers, m")
        if s.shape == (3,):
            s = np.diag(s * np.abs(s))
        variance, axes = np.zeros(3), np.eye(3)
        if s.shape == (3, 3) and np.isfinite(s).all():
            variance, axes = np.linalg.eigh(s)
        if not (variance > 0).all():
            raise InputError("monitor", "sigma", sigma, "three numbers above 0, m, or a covariance")
        z = axes @ (axes.T @ r / np.sqrt(variance))
        square = float(z @ z)
        shifts = np.stack([z, -z], axis=1).ravel() - 0.5  # by one standard deviation
        growth = 0.5 * square * (1 - _GROWTH**-2) - 3 * math.log(_GROWTH)
        raised = self.sums + np.append(shifts, growth)
        alive = raised > 0
        fresh = self.sums == 0
        started = np.where(fresh, self.samples, self.onset)
        before = np.where(fresh[:, None], 0.0, self.total)
        return replace(
            self,
            samples=self.samples + 1,
            sums=np.where(alive, raised, 0.0),
            onset=started,
            total=before + r,
            squares=np.where(fresh, 0.0, self.squares) + square,
        )

    def verdict(self) -> Verdict:
        """Return the verdict on all samples so far, by the largest of the cumulative sums."""
        k = int(np.argmax(self.sums))
        evidence = float(self.sums[k] / self.threshold)
        if evidence < 1.0:
            return Verdict(False, "", self.samples, evidence)
        count = self.samples - int(self.onset[k])
        since = f"over the last {count} poses"
        if _TESTS[k] == "growth":
            grown = math.sqrt(self.squares[k] / (3 * count))
            finding = f"errors are {grown:.1f} times what the model promised {since}"
        else:
            shift = 1e3 * self.total[k, k // 2] / count
            finding = f"the tip is off by {shift:+.2f} mm in {_TESTS[k][1]} {since}"
        return Verdict(True, finding, self.samples, evidence)
