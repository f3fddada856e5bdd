"""What a move leaves ringing at the tip, and how long until it is small."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from longarm_comp.core.compensation.retime import Timed
from longarm_comp.core.errors import InputError
from longarm_comp.core.vibration.modes import Modes
from longarm_comp.math.shaper import Shaper, Way

SMALL_M = 1e-4
"""A ring below it is over: what a good camera sees of one picture."""


@dataclass(frozen=True, eq=False)
class Ring:
    """A free vibration of the tip: ``sum_k tip_k Re(amplitude_k exp(rate_k t))``.

    Attributes:
        rate: (k,) complex, 1/s: ``-damping omega + i omega_d``.
        tip: (k, 3) m per unit of the mode.
        amplitude: (k,) complex, at time 0.
    """

    rate: np.ndarray
    tip: np.ndarray
    amplitude: np.ndarray

    def at(self, times: np.ndarray) -> np.ndarray:
        """(N, 3) m: motion of the tip at times (N,) from 0 on."""
        waves = np.real(self.amplitude * np.exp(np.multiply.outer(times, self.rate)))
        return np.asarray(waves @ self.tip)

    def size_m(self, time_s: float = 0.0) -> float:
        """Bound of the tip's motion from a time on, m."""
        left = np.abs(self.amplitude) * np.exp(self.rate.real * time_s)
        return float(left @ np.linalg.norm(self.tip, axis=1))

    def settle_s(self, limit_m: float = SMALL_M) -> float:
        """Time until it stays below a size, s."""
        if self.size_m() <= limit_m:
            return 0.0
        slowest = float(-self.rate.real.max())
        late = np.log(self.size_m() / limit_m) / slowest
        return float(brentq(lambda t: np.log(self.size_m(t) / limit_m), 0.0, late + 1e-9))


def left_by(modes: Modes, times: np.ndarray, joints: np.ndarray, damping: float) -> Ring:
    """The ring at the end of a motion from rest to rest; the joints go straight in between.

    Args:
        modes: at its end.
        times: (M,) s, increasing, far closer than a period. joints: (M, n).
        damping: share of critical damping of every mode.
    """
    if not 0.0 < damping < 1.0:
        raise InputError("ringing", "damping", damping, "above 0 and below 1")
    speeds = np.diff(joints, axis=0) / np.diff(times)[:, None]
    kicks = np.diff(speeds, axis=0, prepend=0.0, append=0.0) @ modes.driven.T  # (M, k)
    damped = modes.omega * np.sqrt(1.0 - damping**2)
    rate = -damping * modes.omega + 1j * damped
    since = np.exp(np.multiply.outer(times[-1] - times, rate))
    return Ring(rate, modes.tip, (kicks * since).sum(axis=0) / (1j * damped))


def along(
    modes: Modes, way: Way, seconds: float, damping: float, shaper: Shaper | None = None
) -> Ring:
    """The ring after a motion that takes some seconds from time 0 on, shaped if asked for.

    Its time 0 is the motion's end, that of the shaped motion.
    """
    if shaper is not None:
        way, seconds = shaper.shaped(way), seconds + shaper.duration
    fastest = float(modes.hz.max(initial=1.0 / seconds))
    # Samples of a move in a period of the fastest mode
    count = int(np.ceil(32 * max(1.0, fastest * seconds)))
    times = np.linspace(0.0, seconds, count + 1)
    return left_by(modes, times, way(times), damping)


def straight(start: np.ndarray, end: np.ndarray, seconds: float) -> Way:
    """One move from rest to rest, as the driver makes it: a cubic in time."""
    timed = Timed(np.array([0.0, seconds]), np.stack([start, end]), np.zeros((2, len(start))))
    return lambda times: timed.at(np.clip(times, 0.0, seconds))
