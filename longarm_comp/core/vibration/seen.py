"""Frequency and damping of a ring: damped waves fitted to sightings, or readings, after a move.

The amplitudes are linear and eliminated (variable projection); waves are added one after the other
while each takes off far more than noise would.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.special import fdtrc

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.vibration.modes import Modes
from longarm_comp.core.vibration.ring import USUAL_DAMPING

LEAST = 12
"""Smallest number of sightings to which a wave is fitted."""


@dataclass(frozen=True, eq=False)
class SeenWave:
    """One damped wave of the tip, or of the joints."""

    hz: float  # undamped frequency, Hz
    hz_sd: float  # its standard deviation, Hz
    damping: float  # damping ratio
    damping_sd: float  # its standard deviation
    size: np.ndarray  # amplitude at the first sighting: (3,), m, base frame, or of joints (n,)


def fit_waves(times: np.ndarray, seen: np.ndarray) -> list[SeenWave]:
    """Fit up to two damped waves to sightings (N, D) at times (N,), s; return the largest first.

    The list is empty if there is nothing beyond noise. The joints must not be driven any more at
    these times.

    Raises:
        InputError: too few sightings, or their times do not increase.
        JobError: too few sightings in a second for any wave.
    """
    if len(times) < LEAST or (np.diff(times) <= 0.0).any():
        raise InputError("ring", "sightings", len(times), f"{LEAST} or more, one after the other")
    t = times - times[0]
    moved = seen - seen.mean(axis=0)
    unit = float(np.linalg.norm(moved)) or 1.0
    # A number is rounded, and not by chance: a wave may explain all of that
    rounding = float(((np.finfo(float).eps / unit * seen) ** 2).sum())
    seen = moved / unit  # small rings are fitted as well as large ones
    # Sightings in a period; with fewer another frequency fits as well
    fastest = 1.0 / (2.5 * float(np.median(np.diff(t))))
    slowest = 1.0 / float(t[-1])
    if fastest <= slowest:
        raise JobError("too few sightings in a second for any ring", sightings=len(t))
    wide = seen.shape[1]
    more = 2 + 2 * wide  # parameters of a wave
    found: list[float] = []  # omega, damping, omega, damping, ...
    left = _residual(np.array(found), t, seen)
    for _ in range(2):
        tried = 2.0 * np.pi * np.arange(slowest, fastest, 0.1 * slowest)
        begins = [np.array([*found, omega, USUAL_DAMPING]) for omega in tried]
        begin = min(begins, key=lambda p: float((_residual(p, t, seen) ** 2).sum()))
        bounds = (np.tile([0.0, 1e-5], len(begin) // 2), np.tile([np.inf, 0.5], len(begin) // 2))
        fit = least_squares(
            lambda p: _residual(p, t, seen).ravel(), begin, bounds=bounds, x_scale=begin
        )
        now = _residual(fit.x, t, seen)
        free = now.size - wide * (1 + len(begin)) - len(begin)
        if free < 1:
            break
        gain = ((left**2).sum() - (now**2).sum() - rounding) / more
        noise = ((now**2).sum() + rounding) / free
        # Chance at which noise alone would be taken for a wave
        if gain <= 0.0 or fdtrc(more, free, gain / noise) > 1e-6:
            break
        found, left, last = fit.x.tolist(), now, fit
    if not found:
        return []
    noise = (left**2).sum() / (left.size - wide * (1 + len(found)) - len(found))
    sd = np.sqrt(np.diag(noise * np.linalg.pinv(last.jac.T @ last.jac)))
    parts = np.linalg.lstsq(_basis(np.array(found), t), seen, rcond=None)[0][1:]
    made = [
        SeenWave(
            w / (2.0 * np.pi),
            sd[2 * k] / (2.0 * np.pi),
            z,
            sd[2 * k + 1],
            unit * np.hypot(parts[2 * k], parts[2 * k + 1]),
        )
        for k, (w, z) in enumerate(zip(found[::2], found[1::2], strict=True))
    ]
    return sorted(made, key=lambda wave: -float(np.linalg.norm(wave.size)))


def _basis(parameters: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return (N, 1 + 2 k): a constant, and cosine and sine of each damped wave at times t (N,)."""
    columns = [np.ones_like(t)]
    for omega, damping in parameters.reshape(-1, 2):
        decay = np.exp(-damping * omega * t)
        angle = omega * np.sqrt(1.0 - damping**2) * t
        columns += [decay * np.cos(angle), decay * np.sin(angle)]
    return np.stack(columns, axis=1)


def _residual(parameters: np.ndarray, t: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    basis, _ = np.linalg.qr(_basis(parameters, t))
    return np.asarray(xyz - basis @ (basis.T @ xyz))


def as_tips(heard: Sequence[SeenWave], at_ring: Modes) -> list[SeenWave]:
    """Return waves of joints as waves of the tip.

    Joints do not show how the tip swings, so each wave's `size` becomes the tip's motion (3,) in
    the model's mode that is nearest in frequency.
    """
    return [
        replace(wave, size=at_ring.tip[np.argmin(np.abs(np.log(at_ring.hz / wave.hz)))])
        for wave in heard
    ]


def find_least_steps(readings: np.ndarray) -> np.ndarray:
    """Return the smallest change (n,) between successive readings (N, n): a smaller ring is unseen.

    It is 0 for a joint whose readings never change.
    """
    changes = np.abs(np.diff(readings, axis=0))
    changes = np.where(changes > 0.0, changes, np.inf).min(axis=0)
    return np.where(np.isfinite(changes), changes, 0.0)


def correct_modes(modes: Modes, at_ring: Modes, seen: Sequence[SeenWave]) -> Modes:
    """Return modes with their frequencies corrected by those that were seen at another posture.

    Weight bends an arm up and down, so a calibration at rest determines this bending, but sideways
    bending only in part.  So each mode is corrected by the factor (seen by model frequency) of the
    wave whose vertical share of motion is most like its own.

    Args:
        modes: modes of the model at any posture.
        at_ring: modes of the model at the posture where the waves were seen.
        seen: waves of the tip, as `fit_waves` returns them.
    """
    if not seen or not len(modes.omega) or not len(at_ring.omega):
        return modes
    steep = _steepness(np.array([wave.size for wave in seen]))
    apart = np.abs(np.subtract.outer(steep, _steepness(at_ring.tip)))
    slow = at_ring.omega < 2.0 * at_ring.omega[0]
    model = at_ring.hz[np.where(slow, apart, np.inf).argmin(axis=1)]
    factors = np.array([wave.hz for wave in seen]) / model
    nearest_wave = np.abs(np.subtract.outer(_steepness(modes.tip), steep)).argmin(axis=1)
    return replace(modes, omega=modes.omega * factors[nearest_wave])


def _steepness(moves: np.ndarray) -> np.ndarray:
    """Return the vertical share (k,), 0 to 1, of motions (k, 3)."""
    return np.asarray(np.abs(moves[:, 2]) / np.linalg.norm(moves, axis=1))
