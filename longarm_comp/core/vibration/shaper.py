"""Input shaping: a move becomes a sum of delayed copies whose vibrations cancel.

All joints are shaped alike, so a straight move stays straight and within its limits of velocity and
acceleration.  A copy begins with the move or later, and its end is delayed at least as much.  The
weights, none negative, leave the least vibration at the tip, by the modes all along the motion and
for frequencies that may be wrong.  Source: Singer and Seering 1990.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.modes import Modes, find_modes_along
from longarm_comp.core.vibration.ring import USUAL_DAMPING, find_amplitudes, sample_times
from longarm_comp.math.shaper import Shaper, Way

_FREQUENCY_SD = 0.05
"""Relative standard deviation of a model's frequencies: calibrated stiffness is right to 10 %."""
_DELAYS = 7
"""Number of delays with which copies may begin and end, from 0 to the longest period."""
_PLACES, _KNOWN = 41, 9
"""Number of places along a motion where modes are used, and of those where they are computed: over
a ninth of a joint's range, cubics interpolate them well."""
_ROUNDS = 3
"""Rounds of computing the weights, and the arm's place at each time: each depends on the other."""


def find_way_modes(model: Model, way: Way, seconds: float) -> list[Modes]:
    """Return the modes at evenly spaced places along a motion.

    Args:
        way: the motion, which begins at time 0.
        seconds: its duration.
    """
    times, share = _progress(way, seconds)
    known = np.interp(np.linspace(0.0, 1.0, _KNOWN), share, times)
    return find_modes_along(model, way(known), _PLACES)


def _progress(way: Way, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times (M,), and the share of the motion that is done at each, 0 to 1."""
    times = np.linspace(0.0, seconds, 8 * _PLACES)
    moved = np.abs(np.diff(way(times), axis=0))
    gone = np.cumsum((moved / np.maximum(moved.sum(axis=0), 1e-12)).max(axis=1))
    return times, np.append(0.0, gone) / max(float(gone[-1]), 1e-12)


def find_shaper(along: Sequence[Modes], way: Way, seconds: float, damping: float) -> Shaper | None:
    """Return the shaper of a motion from rest to rest; None where a place has no modes.

    It makes the motion longer by at most a period of the lowest mode.

    Args:
        along: modes at evenly spaced places along the motion.
        way: the motion, which begins at time 0.
        seconds: its duration without the shaper.
        damping: damping ratio of the modes.
    """
    from scipy.optimize import nnls  # a node that sends moves as they are starts without

    if not all(len(modes.omega) for modes in along):
        return None
    late = np.linspace(0.0, 2.0 * np.pi / min(m.omega[0] for m in along), _DELAYS)
    begin, end = np.triu_indices(_DELAYS)
    parts = Shaper(np.full(len(begin), 1.0 / len(begin)), late[begin], late[end])
    times = sample_times(along, seconds + parts.duration)
    joints = np.moveaxis(parts.parts(way, times, seconds), 0, 2)
    progress = np.interp(parts.since(times, seconds), *_progress(way, seconds))
    # A normal distribution by three points (Gauss and Hermite)
    factors = 1.0 + _FREQUENCY_SD * np.sqrt(3.0) * np.array([-1.0, 0.0, 1.0])
    chances = np.sqrt([1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0])[:, None, None]
    for _ in range(_ROUNDS):
        where = np.rint((len(along) - 1) * (parts.weights @ progress)).astype(int)
        left = find_amplitudes(along, where, times, joints, damping, factors)
        sizes = np.linalg.norm(along[-1].tip[: left.shape[1]], axis=1)[:, None]
        left = (chances * sizes * left).reshape(-1, len(begin))
        rows = np.concatenate([left.real, left.imag])
        # The last row: the shares add up to 1.  Its weight changes their sum, not their ratios.
        like = np.abs(rows).max()
        table = np.vstack([rows, np.full(len(begin), like)])
        weights, _ = nnls(table, np.append(np.zeros(len(rows)), like))
        parts = replace(parts, weights=weights / weights.sum())
    used = parts.weights > 0.0
    return Shaper(parts.weights[used], parts.begins[used], parts.ends[used])


def shaping(model: Model, names: list[str], where: str) -> Callable[[Way, float], Shaper | None]:
    """Return a function that finds the shaper of a motion from rest to rest.

    It takes the motion, with joints in the order of `names`, and its duration (s). It returns None
    where no joint moves, or the model does not bend.

    Raises:
        InputError: a joint of the arm is not among the names; the error names ``where``.
    """
    arm, order = model.arm, model.arm.order(names, where)
    damping = arm.damping or USUAL_DAMPING

    def usual(times: np.ndarray) -> np.ndarray:
        return arm.mid + np.outer(times, 0.1 * (arm.upper - arm.lower))

    # Imports and compilation take seconds: they are done now, before the first move.
    find_shaper(find_way_modes(model, usual, 1.0), usual, 1.0, damping)

    def of(way: Way, seconds: float) -> Shaper | None:
        def mine(times: np.ndarray) -> np.ndarray:
            return way(times)[:, order]

        if not seconds > 0.0 or not np.ptp(mine(np.linspace(0.0, seconds, _PLACES)), axis=0).any():
            return None
        along = find_way_modes(model, mine, seconds)
        return find_shaper(along, mine, seconds, damping)

    return of
