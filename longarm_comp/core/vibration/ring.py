"""The ring (free vibration) that a move leaves at the tip, and the time until it is small."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.measuring import VISIBLE_M
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.modes import Modes, find_modes
from longarm_comp.math.cubic_path import CubicPath, monotone_slopes
from longarm_comp.math.shaper import Way

USUAL_DAMPING = 0.01
"""Damping ratio of an arm that declares none. If it has 0.05 more, a shaper leaves 6 % of a ring.
"""


@dataclass(frozen=True, eq=False)
class _Ring:
    """A free vibration of the tip: ``sum_k tip_k Re(amplitude_k exp(rate_k t))``."""

    rate: np.ndarray  # (k,) complex, 1/s: ``-damping omega + i omega_d``
    tip: np.ndarray  # (k, 3) m per unit of the mode
    amplitude: np.ndarray  # (k,) complex, at time 0

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the motion of the tip (N, 3), m, at times (N,), s, from 0 on."""
        waves = np.real(self.amplitude * np.exp(np.multiply.outer(times, self.rate)))
        return np.asarray(waves @ self.tip)

    def size_m(self, time_s: float = 0.0) -> float:
        """Return an upper bound of the tip's motion (m) from a time (s) on."""
        left = np.abs(self.amplitude) * np.exp(self.rate.real * time_s)
        return float(left @ np.linalg.norm(self.tip, axis=1))

    def settle_s(self, limit_m: float = VISIBLE_M) -> float:
        """Return the time (s) from which on the bound `size_m` is within a limit (m)."""
        if self.size_m() <= limit_m:
            return 0.0
        slowest = float(-self.rate.real.max())
        early, late = 0.0, float(np.log(self.size_m() / limit_m)) / slowest
        while late - early > 1e-6 * late:
            middle = 0.5 * (early + late)
            early, late = (middle, late) if self.size_m(middle) > limit_m else (early, middle)
        return late


def find_amplitudes(
    way: Sequence[Modes],
    where: np.ndarray,
    times: np.ndarray,
    joints: np.ndarray,
    damping: float,
    factors: np.ndarray,
) -> np.ndarray:
    """Return the complex amplitudes (F, k, P) of k modes at the end of P motions from rest.

    Joints move linearly between the times. Where the modes of one place follow those of another,
    the masses keep their positions and velocities.

    Args:
        way: modes at places along the motion.
        where: (M,) index of the place at each time, not falling.
        times: (M,) s, increasing, far closer than a period.
        joints: (M, n, P) rad and m.
        damping: damping ratio of every mode.
        factors: (F,) factors on all frequencies; each gives a result.

    Raises:
        InputError: the damping is not between 0 and 1.
    """
    if not 0.0 < damping < 1.0:
        raise InputError("ringing", "damping", damping, "above 0 and below 1")
    count = min(len(modes.omega) for modes in way)
    rates = [np.multiply.outer(factors, _rates(modes, damping)[:count])[..., None] for modes in way]
    speeds = np.diff(joints, axis=0) / np.diff(times)[:, None, None]
    wave = np.zeros((len(factors), count, joints.shape[2]), complex)
    here, before = int(where[0]), np.zeros(joints.shape[1:])
    spans = np.diff(times, append=times[-1])
    for step, took, speed in zip(where, spans, [*speeds, np.zeros_like(before)], strict=True):
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


def sample_times(modes: Sequence[Modes], seconds: float) -> np.ndarray:
    """Return times (M,) of a motion, s from 0, far closer than a period of these modes."""
    fastest = max(float(each.hz.max(initial=1.0 / seconds)) for each in modes)
    return np.linspace(0.0, seconds, int(np.ceil(_IN_A_PERIOD * max(1.0, fastest * seconds))) + 1)


_IN_A_PERIOD = 16
"""Samples in a period of the fastest mode: joints that move linearly between them are off by a
thousandth of the motion."""


def find_ring(modes: Modes, way: Way, seconds: float, damping: float) -> _Ring:
    """Return the ring that a motion from rest to rest leaves; its time 0 is the motion's end.

    Args:
        modes: modes at the end of the motion.
        way: the motion, which begins at time 0.
        seconds: its duration.
        damping: damping ratio of every mode.
    """
    times = sample_times([modes], seconds)
    joints, left = way(times)[..., None], np.zeros((1, 0, 1), complex)
    if len(modes.omega):
        where = np.zeros(len(times), int)
        left = find_amplitudes([modes], where, times, joints, damping, np.ones(1))
    return _Ring(_rates(modes, damping), modes.tip, left[0, :, 0])


def move_straight(start: np.ndarray, end: np.ndarray, seconds: float) -> Way:
    """Return a move of joints (n,) from rest to rest, as the driver makes it: a cubic in time."""
    return CubicPath(np.array([0.0, seconds]), np.stack([start, end]), np.zeros((2, len(start)))).at


def ring_of_moves(
    model: Model, joints: np.ndarray, move_s: float, damping: float
) -> list[tuple[Modes, _Ring]]:
    """Return the modes at each posture (N, n), and the ring of the move to it from the one before.

    The first move begins in the middle of the joint box.

    Args:
        move_s: duration of a move, s.
        damping: damping ratio of every mode.

    Raises:
        InputError: `move_s` is not above 0, or `damping` is not between 0 and 1.
    """
    if not 0.0 < move_s < np.inf:
        raise InputError("ringing", "time of a move", move_s, "above 0 s")
    made, before = [], model.arm.mid
    for end in np.atleast_2d(joints):
        found = find_modes(model, end)
        made.append((found, find_ring(found, move_straight(before, end, move_s), move_s, damping)))
        before = end
    return made


REST_S = 0.3
"""Shortest time to rest, s, which servos and cameras need; used if arm.yaml declares no damping."""


def rest_s(model: Model, joints: np.ndarray, move_s: float, given: float | None) -> float:
    """Return how long to rest before a sighting, s, so that the ring of 90 % of the moves is over.

    Unless `given`, it is at least `REST_S`, and `REST_S` if arm.yaml declares no `damping`.

    Args:
        joints: (N, n) postures, one after the other.
        move_s: duration of a move, s.
        given: time to return instead, s, or None.
    """
    if given is not None:
        return given
    damping = model.arm.damping
    if damping is None or not len(joints) or not move_s > 0.0:
        return REST_S
    rings = ring_of_moves(model, joints[:_LOOKED_AT], move_s, damping)
    return max(REST_S, float(np.quantile([ring.settle_s() for _, ring in rings], 0.9)))


_LOOKED_AT = 32
"""Largest number of moves whose rings are computed."""


@dataclass(frozen=True)
class MoveRing:
    """The ring that the model expects at the tip after a move."""

    hz: float  # of the slowest mode
    size_m: float  # at the end of the move
    settle_s: float  # time to rest
    damping: float  # damping ratio
    declared: bool  # whether arm.yaml declares the damping

    def describe(self) -> str:
        """Describe the ring in one line."""
        told = "" if self.declared else " assumed"
        swing = f"{1e3 * self.size_m:.2g} mm at most, {self.hz:.2g} Hz"
        return (
            f"the tip swings by {swing}; within {1e3 * VISIBLE_M:g} mm after {self.settle_s:.1f} s "
            f"(damping {self.damping:g}{told})"
        )


def ring_after(
    model: Model, context: Context, start: np.ndarray, points: np.ndarray, times: np.ndarray
) -> MoveRing | None:
    """Return the ring after a move from rest at ``start`` (n,) through points (k, n), times (k,) s.

    None where nothing of the model bends.
    """
    found = find_modes(model, points[-1], context)
    if not len(found.omega):
        return None
    later = times > 0.0
    when, joints = np.append(0.0, times[later]), np.vstack([start, points[later]])
    path = CubicPath(when, joints, monotone_slopes(when, joints))
    damping = model.arm.damping or USUAL_DAMPING
    ring = find_ring(found, path.at, path.duration, damping) if path.duration > 0.0 else None
    size_m, settle_s = (0.0, 0.0) if ring is None else (ring.size_m(), ring.settle_s())
    return MoveRing(float(found.hz[0]), size_m, settle_s, damping, model.arm.damping is not None)
