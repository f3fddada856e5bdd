"""Where a path is slowed down so that joints that turn have time to take up their play.

The price of time is the plan's own.  A plan of a duration D and a mean squared jerk j^2 would lose
5 D j^2 / D of its squared jerk by a second more.  Each take-up, and each slowing down for it, lasts
until a second more would save as little:

- A play w that is taken up in a time T by a quintic has a squared jerk of 720 w^2 / T^5, so
  T^6 = 720 w^2 / j^2.  Its mean squared jerk is the plan's.
- Slowing down from a speed v by a share c of it and up again, each in a time t by a cubic speed,
  has 24 (c v)^2 / t^3 and takes c t longer, so t^4 = 14.4 c v^2 / j^2.

Where these meet each other and the plan's own jerk, they jerk more together than each by itself.
Then time has a lower price, so that the whole path jerks no more than it would without play.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from longarm_comp.core.compensation.take_up import Turn
from longarm_comp.math.cubic_path import CubicPath, smooth_slopes


def slowed(
    times: np.ndarray, ways: np.ndarray, unit: np.ndarray,
    begins: np.ndarray, turns: Sequence[Turn], most: float,
    made: Callable[[np.ndarray], CubicPath],
) -> np.ndarray:  # fmt: skip
    """(k,) s: planned times (k,) made later where joints turn.

    Args:
        ways: (k, n) joints as if none turned.
        unit: (n,) in which jerks and speeds of joints add up.
        begins: (n,) what joints go on the first way besides.
        turns: what joints cross where they turn.
        most: share by which the path may take longer.  Where that is less than it takes, time has
            a higher price.
        made: the path to be sent, at times (k,).
    """
    plan = CubicPath(times, ways, smooth_slopes(times, ways))
    planned2, allowed_s = plan.mean_square_jerk(unit), most * float(np.ptp(times))
    jerk2 = planned2
    first2 = float(((begins / unit) ** 2).sum())
    if not ((turns or first2) and jerk2 and allowed_s):
        return times
    steps = np.diff(times)[:, None]
    speed2 = ((np.diff(ways, axis=0) / unit / steps) ** 2).sum(axis=1)
    enough = True
    for _ in range(_ROUNDS):
        later = _later(times, speed2, unit, turns, jerk2)
        lasts = (720.0 * first2 / jerk2) ** (1.0 / 6.0)
        later[0] += max(0.0, lasts - float(steps[0, 0]))
        if not later.any():
            return times
        over = float(later.sum()) / allowed_s
        slow = np.append(times[0], times[1:] + np.cumsum(later / max(over, 1.0)))
        enough &= over <= 1.0
        if over > 1.0:
            jerk2 *= over**_STEEP
        elif enough and (more := made(slow).mean_square_jerk(unit) / planned2) > 1.0 + _NEAR:
            jerk2 /= more**_ALONE
        else:
            break
    return slow


_ROUNDS, _STEEP = 4, 4.0
"""Time goes with the fourth to sixth root of its price: few rounds find it, from above."""
_ALONE, _NEAR = 2.0, 0.02
"""The squared jerk of what is slowed down goes with its price; as much again is the plan's own.
A hundredth of the jerk is not looked for."""


def _later(
    times: np.ndarray, speed2: np.ndarray, unit: np.ndarray, turns: Sequence[Turn], jerk2: float
) -> np.ndarray:
    """(k - 1,) s: by how much each way takes longer, at a price of time of ``5 jerk2``."""
    later = np.zeros(len(times) - 1)
    for joint, first, last, crossed in turns:
        near_s = times[last] - times[first]
        lasts = (720.0 * (crossed / unit[joint]) ** 2 / jerk2) ** (1.0 / 6.0)
        if last == 1 or lasts <= near_s:  # on the first way nothing moves yet
            continue
        share = 1.0 - near_s / lasts
        away, reaches_s = times - 0.5 * (times[first] + times[last]), 0.5 * near_s
        for _ in range(_ROUNDS):  # how fast it is there depends on how long it takes
            there = np.abs(away[1:] + away[:-1]) <= 2.0 * reaches_s
            there[first:last] = True
            fast2 = max(speed2[there].mean(), speed2[first:last].mean())
            change_s = (14.4 * share * fast2 / jerk2) ** 0.25
            reaches_s = 0.5 * near_s + change_s * (1.0 - 0.5 * share)
        planned, real = _slow(0.5 * near_s, 0.5 * lasts, share, change_s)
        gained = np.sign(away) * np.interp(np.abs(away), planned, real - planned)
        later += np.diff(gained) ** _TOGETHER
    return np.asarray(later ** (1.0 / _TOGETHER))


_TOGETHER = 3
"""Turns that are near each other use the same time: the most of what each takes, but smoothly."""
_SHARE = np.linspace(0.0, 1.0, 129)


def _slow(
    near_s: float, lasts: float, share: float, change_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Planned times after the middle of a turn, and the real ones: slow, then as planned again."""
    real = change_s * _SHARE
    planned = (1.0 - share) * real + share * change_s * (_SHARE**3 - 0.5 * _SHARE**4)
    return np.append(0.0, near_s + planned), np.append(0.0, lasts + real)
