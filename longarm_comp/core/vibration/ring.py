"""What a move leaves ringing at the tip, and how long until it is small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.core.vibration.modes import Modes
from longarm_comp.math.cubic_path import CubicPath
from longarm_comp.math.shaper import Way

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
        early, late = 0.0, float(np.log(self.size_m() / limit_m)) / slowest
        while late - early > 1e-6 * late:
            middle = 0.5 * (early + late)
            early, late = (middle, late) if self.size_m(middle) > limit_m else (early, middle)
        return late


def amplitudes(
    way: Sequence[Modes],
    where: np.ndarray,
    times: np.ndarray,
    joints: np.ndarray,
    damping: float,
    factors: np.ndarray,
) -> np.ndarray:
    """(F, k, P) amplitudes at the end of P motions from rest; the joints go straight in between.

    The modes change on the way: where one posture's follow upon another's, the masses go on where
    they are, and as fast.

    Args:
        way: modes at places of the way. where: (M,) rising, the place at each time.
        times: (M,) s, increasing, far closer than a period. joints: (M, n, P).
        damping: share of critical damping of every mode.
        factors: (F,) by which all frequencies are multiplied, each in turn.
    """
    if not 0.0 < damping < 1.0:
        raise InputError("ringing", "damping", damping, "above 0 and below 1")
    count = min(len(modes.omega) for modes in way)
    rates = [np.multiply.outer(factors, _rates(modes, damping)[:count])[..., None] for modes in way]
    speeds = np.diff(joints, axis=0) / np.diff(times)[:, None, None]
    wave = np.zeros((len(factors), count, joints.shape[2]), complex)
    here, before = int(where[0]), np.zeros(joints.shape[1:])
    for step, took, speed in zip(where, np.diff(times, append=times[-1]),
                                 [*speeds, np.zeros_like(before)], strict=True):  # fmt: skip
        while here < step:
            old, new = way[here], way[here + 1]
            pull = new.shape[:count] * new.mass
            pace = old.shape[:count].T @ (wave * rates[here]).real
            pace = pull @ (pace + (old.carried - new.carried) @ before)
            place = pull @ old.shape[:count].T @ wave.real
            rate = rates[here + 1]
            wave = place + 1j * (rate.real * place - pace) / rate.imag
            here += 1
        kick = way[here].driven[:count] @ (speed - before)
        wave = (wave + kick / (1j * rates[here].imag)) * np.exp(rates[here] * took)
        before = speed
    return wave


def _rates(modes: Modes, damping: float) -> np.ndarray:
    return np.asarray(modes.omega * (-damping + 1j * np.sqrt(1.0 - damping**2)))


def left_by(modes: Modes, times: np.ndarray, joints: np.ndarray, damping: float) -> Ring:
    """The ring at the end of a motion (M, n) from rest to rest, by the modes there."""
    if not len(modes.omega):
        return Ring(np.zeros(0, complex), modes.tip, np.zeros(0, complex))
    whole = amplitudes([modes], np.zeros(len(times), int), times, joints[..., None], damping,
                       np.ones(1))  # fmt: skip
    return Ring(_rates(modes, damping), modes.tip, whole[0, :, 0])


def sampled(modes: Sequence[Modes], seconds: float) -> np.ndarray:
    """(M,) s from 0 on: times in a motion that are far closer than a period of these modes."""
    fastest = max(float(each.hz.max(initial=1.0 / seconds)) for each in modes)
    return np.linspace(0.0, seconds, int(np.ceil(_IN_A_PERIOD * max(1.0, fastest * seconds))) + 1)


_IN_A_PERIOD = 16
"""Samples in a period of the fastest mode: a straight line of the joints between two of them is
off by a thousandth of the way."""


def along(modes: Modes, way: Way, seconds: float, damping: float) -> Ring:
    """The ring after a motion that takes some seconds from time 0 on; its time 0 is their end."""
    times = sampled([modes], seconds)
    return left_by(modes, times, way(times), damping)


def straight(start: np.ndarray, end: np.ndarray, seconds: float) -> Way:
    """One move from rest to rest, as the driver makes it: a cubic in time."""
    return CubicPath(np.array([0.0, seconds]), np.stack([start, end]), np.zeros((2, len(start)))).at
