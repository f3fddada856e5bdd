"""Play along a path: how far joints stand behind their commands, and when this play is taken up.

A joint's *lag* is its command less the position where it stands.  Where the joint reverses, its
command has to cross the play while the joint stands still.  The play is taken up smoothly while the
planned joint is near its reversal, and the path is slowed down for it.

How long this takes is a balance of time against jerk, with the exchange rate of the plan itself.
A plan with a mean squared jerk j^2 would lose 5 j^2 of its squared jerk (integrated over time) if
it took a second more.  Each take-up, and each slowing down for it, lasts until a further second
would save no more than that:

- A play w that is taken up in a time T by a quintic has a squared jerk of 720 w^2 / T^5, so
  T^6 = 720 w^2 / j^2.
- Slowing down from a speed v by a share c of it and up again, each in a time t by a cubic speed,
  has 24 (c v)^2 / t^3 and takes c t longer, so t^4 = 14.4 c v^2 / j^2.

If these coincide with each other and with the plan's own jerk, the jerk of the sum is larger than
that of its parts.  Then more time is allowed, until the whole path has no more mean squared jerk
than the plan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import SAME_POSE, History
from longarm_comp.core.compensation.unknown import history_joints
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.math.cubic_path import CubicPath, smooth_slopes

_ROUNDS, _STEEP = 4, 4.0
"""Delays fall with the fourth to sixth root of the squared jerk that is allowed for them, so few
rounds find it. With an exponent of 4 they approach the permitted time from above."""
_ALONE, _NEAR = 2.0, 0.02
"""Exponent of the reduction of the allowed squared jerk: 2, because half of the jerk is the plan's
own. And the share by which the squared jerk may exceed the plan's."""
_TOGETHER = 3
"""Exponent of a smooth maximum: reversals that overlap in time share the longest delay."""
_PART = np.linspace(0.0, 1.0, 129)
"""Parts of the time of a change of speed at which planned and real times are compared."""


@dataclass(frozen=True, eq=False)
class PathLag:
    """The lag of joints along a path of a model's arm, and where it changes."""

    model: Model  # the physics that commands are solved with
    tolerance_m: float  # how far the tip may leave its path where a joint reverses, m

    @cached_property
    def joints(self) -> list[int]:
        """The commanded joints (0-based) whose history an effect of the model reads."""
        return sorted({joint for held in history_joints(self.model).values() for joint in held})

    @cached_property
    def tolerance(self) -> np.ndarray:
        """The (n,) joint motion, rad or m, that moves the tip by the tolerance at full reach."""
        arm = self.model.arm
        return np.where(arm.slides, 1.0, 1.0 / reach(arm)) * self.tolerance_m

    def compute_lag(self, q: np.ndarray, context: Context) -> np.ndarray:
        """Compute the lag (k, n), rad and m, at commands q (k, n).

        It is the joint motion by all effects that read the history.
        """
        lag, arm = np.zeros_like(q), self.model.arm
        if not self.joints:
            return lag
        every = [(effect, effect.history_joints(arm)) for effect in self.model.effects]
        playing = [(effect, joints) for effect, joints in every if joints]
        loaded = any(effect.loaded for effect, _ in playing)
        make = self.model.posture_without_sag if loaded else self.model.posture_without_frames
        posture = make(unstack(q), context)
        for effect, joints in playing:
            twists = effect.twists(posture)
            for joint in joints:
                row = arm.commanded[joint]
                if twist := twists.get(posture.bearing(row)):
                    lag[:, joint] -= twist[2 if arm.slides[joint] else 5]
        return lag

    def find_history(
        self, stands: np.ndarray, lag: np.ndarray, history: History, start: np.ndarray | None
    ) -> History:
        """Find the history of the joints at each of k way-points.

        The side of a joint changes with the motion of the joint itself, not while its command
        crosses the play at a reversal. A reversal that is too short to matter at the tip does not
        change it.  If a joint reverses while it is still near its first position, it counts as
        reversing at once.

        Args:
            stands, lag: (k, n) positions of the joints, and by how much their commands are ahead.
            history, start: of the joints before the path, and where they stood (None: not known).
        """
        steady, half = stands.copy(), 0.5 * self.tolerance
        low, high = stands - half, stands + half
        for row in range(1, len(stands)):
            steady[row] = np.minimum(np.maximum(steady[row - 1], low[row]), high[row])
        came = history.along(steady + lag, start)
        moves = np.diff(steady, axis=0, prepend=steady[:1])
        last = np.where(np.abs(moves) >= SAME_POSE, np.arange(len(moves))[:, None], 0)
        last = np.maximum.accumulate(last, axis=0)
        sides = np.sign(np.take_along_axis(moves, last, axis=0))
        sides, joints = np.where(last > 0, sides, came.approach[0]), np.arange(sides.shape[1])
        reversed_at = np.argmax(sides != sides[0], axis=0)
        before = np.arange(len(sides))[:, None] < reversed_at
        at_once = (~before | (np.abs(stands - stands[0]) <= self.tolerance)).all(axis=0)
        at_once &= np.isin(joints, self.joints)
        before[0] = False
        changed = before & at_once
        sides = np.where(changed, sides[reversed_at, joints], sides)
        legs = np.where(changed[..., None], came.legs[reversed_at, joints], came.legs)
        return History(sides, legs, came.last_way)

    def find_reversals(
        self, stands: np.ndarray, lag: np.ndarray, sides: np.ndarray
    ) -> list[Reversal]:
        """Find the reversals: where one of the sides (k, n) that `find_history` found changes."""
        found = []
        for joint in self.joints:
            before = 0  # the reversal before this one
            for last in (np.flatnonzero(np.diff(sides[:, joint])) + 1).tolist():
                way = stands[before:last, joint]
                end = way.max() if sides[last, joint] < 0 else way.min()
                away = np.flatnonzero(np.abs(way - end) > self.tolerance[joint])
                first = min(before + (int(away[-1]) + 1 if len(away) else 0), last - 1)
                crossed = float(lag[last, joint] - lag[first, joint])
                found.append(Reversal(joint, first, last, crossed))
                before = last
        return found


class Reversal(NamedTuple):
    """A reversal of a joint on a path, where the joint takes up its play."""

    joint: int  # its number, 0-based
    first: int  # number (0-based) of the first way-point near the reversal
    last: int  # number of the last one
    crossed: float  # change of the joint's lag between the two, rad or m


def take_up_play(
    way: np.ndarray, off: np.ndarray, lag: np.ndarray, reversals: list[Reversal], times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Make the play be taken up smoothly in time at each reversal.

    Args:
        way: (k, n) joints as if none reversed, rad and m.
        off: (k, n) small change of these, because play also moves the tip.
        lag: (k, n) by how much commands are ahead of the joints.
        reversals: the reversals of the path.
        times: (k,) s.

    Returns:
        Where the joints stand, and how far their commands are beyond, (k, n) each.
    """
    off, lag = off.copy(), lag.copy()
    for joint, first, last, crossed in reversals:
        part = slice(first, last + 1)
        share = (times[part] - times[first]) / (times[last] - times[first])
        share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        lag[part, joint] = lag[first, joint] + share * crossed
        off[part] = off[first] + np.multiply.outer(share, off[last] - off[first])
    return way + off, lag


def slow_down(
    times: np.ndarray,
    ways: np.ndarray,
    unit: np.ndarray,
    begins: np.ndarray,
    reversals: list[Reversal],
    most: float,
    path_at: Callable[[np.ndarray], CubicPath],
) -> np.ndarray:
    """Return the planned times (k,), s, delayed where joints reverse.

    Args:
        times: (k,) s, the planned times.
        ways: (k, n) joints as if none reversed, rad and m.
        unit: (n,) scale of each joint: jerks and speeds are divided by it before they are added.
        begins: (n,) by how much the commands move further in the first step than planned.
        reversals: the reversals of the path.
        most: share by which the path may take longer.  Delays that would need more are shortened.
        path_at: returns the path to send for times (k,).
    """
    plan = CubicPath(times, ways, smooth_slopes(times, ways))
    planned2, allowed_s = plan.mean_square_jerk(unit), most * float(np.ptp(times))
    jerk2 = planned2
    first2 = float(((begins / unit) ** 2).sum())
    if not ((reversals or first2) and jerk2 and allowed_s):
        return times
    steps = np.diff(times)[:, None]
    speed2 = ((np.diff(ways, axis=0) / unit / steps) ** 2).sum(axis=1)
    enough = True
    for _ in range(_ROUNDS):
        delay_s = _delay_at_reversals(times, speed2, unit, reversals, jerk2)
        takes_s = _take_up_time(first2, jerk2)
        delay_s[0] += max(0.0, takes_s - float(steps[0, 0]))
        if not delay_s.any():
            return times
        over = float(delay_s.sum()) / allowed_s
        slow = np.append(times[0], times[1:] + np.cumsum(delay_s / max(over, 1.0)))
        enough &= over <= 1.0
        if over > 1.0:
            jerk2 *= over**_STEEP
        elif enough and (more := path_at(slow).mean_square_jerk(unit) / planned2) > 1.0 + _NEAR:
            jerk2 /= more**_ALONE
        else:
            break
    return slow


def _take_up_time(square: float, jerk2: float) -> float:
    """Return the time T, s, of a take-up by the formula above, for w^2 (`square`) and j^2."""
    return float((720.0 * square / jerk2) ** (1.0 / 6.0))


def _delay_at_reversals(
    times: np.ndarray, speed2: np.ndarray, unit: np.ndarray, reversals: list[Reversal], jerk2: float
) -> np.ndarray:
    """Compute by how much each step from way-point to way-point takes longer, (k - 1,) s.

    Args:
        speed2: (k - 1,) squared speed of the joints in each step, in `unit` per second.
        jerk2: mean squared jerk that is allowed, as j^2 in the formulas above.
    """
    delay_s = np.zeros(len(times) - 1)
    for joint, first, last, crossed in reversals:
        near_s = times[last] - times[first]
        takes_s = _take_up_time((crossed / unit[joint]) ** 2, jerk2)
        if last == 1 or takes_s <= near_s:  # in the first step nothing moves yet
            continue
        share = 1.0 - near_s / takes_s
        away, reaches_s = times - 0.5 * (times[first] + times[last]), 0.5 * near_s
        for _ in range(_ROUNDS):  # how fast it is there depends on how long it takes
            there = np.abs(away[1:] + away[:-1]) <= 2.0 * reaches_s
            there[first:last] = True
            nearby2 = max(speed2[there].mean(), speed2[first:last].mean())
            change_s = (14.4 * share * nearby2 / jerk2) ** 0.25
            reaches_s = 0.5 * near_s + change_s * (1.0 - 0.5 * share)
        # Planned and real times after the middle of the reversal: slow, then as planned again
        slow_s = change_s * _PART
        fast_s = (1.0 - share) * slow_s + share * change_s * (_PART**3 - 0.5 * _PART**4)
        planned = np.append(0.0, 0.5 * near_s + fast_s)
        real = np.append(0.0, 0.5 * takes_s + slow_s)
        lost_s = np.sign(away) * np.interp(np.abs(away), planned, real - planned)
        delay_s += np.diff(lost_s) ** _TOGETHER
    return np.asarray(delay_s ** (1.0 / _TOGETHER))
