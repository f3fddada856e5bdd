"""Play along a path: what joints stand behind their commands by, and when it is taken up.

Where a joint turns, its command has to cross its play while the joint stands still.  In one step
that is a kick.  As long as the joint as planned stays near its turn, though, it may as well stand:
the play is taken up smoothly over that time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.retime import Timed, slopes_of
from longarm_comp.core.compensation.unknown import history_joints
from longarm_comp.core.effects.joint_term import reach
from longarm_comp.core.model.model import Model, unstack


@dataclass(frozen=True, eq=False)
class TakeUp:
    """How a model's arm takes up what the history of its joints leaves.

    Attributes:
        model: physics that commands are solved with.
        tolerance_m: the tip may be so far from its way where a joint turns.
    """

    model: Model
    tolerance_m: float

    @cached_property
    def joints(self) -> list[int]:
        """Joints (0-based) whose history matters."""
        return sorted({joint for held in history_joints(self.model).values() for joint in held})

    @cached_property
    def near(self) -> np.ndarray:
        """(n,) a joint that stands so far from its way moves the tip within the tolerance."""
        arm = self.model.arm
        slides = [arm.joints[row - 1].type == "prismatic" for row in arm.commanded]
        return np.where(slides, 1.0, 1.0 / reach(arm)) * self.tolerance_m

    def steady(self, q: np.ndarray) -> np.ndarray:
        """(k, n): joints (k, n) without ways back that are too short to matter at the tip."""
        made, half = q.copy(), 0.5 * self.near
        low, high = q - half, q + half
        for row in range(1, len(q)):
            made[row] = np.minimum(np.maximum(made[row - 1], low[row]), high[row])
        return made

    def lag(self, q: np.ndarray, context: Context) -> np.ndarray:
        """(k, n): how far commands (k, n) are beyond where their joints stand, by their history."""
        behind, arm = np.zeros_like(q), self.model.arm
        posture = self.model.unsagged(unstack(q), context)
        for effect in self.model.effects:
            twists = effect.twists(posture) if effect.history_joints(arm) else {}
            for joint in effect.history_joints(arm):
                row = arm.commanded[joint]
                if twist := twists.get(posture.bearing(row)):
                    behind[:, joint] -= twist[2 if arm.joints[row - 1].type == "prismatic" else 5]
        return behind

    def at_once(self, q: np.ndarray, came: History) -> History:
        """The history, joints turned on the first way that turn while near where they start."""
        approach, legs = came.approach.copy(), came.legs.copy()
        for joint in self.joints:
            turned = int(np.argmax(came.approach[:, joint] != came.approach[0, joint]))
            if (np.abs(q[:turned, joint] - q[0, joint]) <= self.near[joint]).all():
                approach[1:turned, joint] = approach[turned, joint]
                legs[1:turned, joint] = legs[turned, joint]
        return replace(came, approach=approach, legs=legs)

    def spread(
        self, q: np.ndarray, lag: np.ndarray, sides: np.ndarray, times: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Commands (k, n), each lag (k, n) taken up while its joint is near its turn.

        A joint that turns where the path begins takes up its play before anything moves. Also by
        how many seconds the first way therefore has to last longer.

        Args:
            sides: (k, n) that the joints come from: they change where a joint has turned.
            times: (k,) s.
        """
        made, stands, first_up = q.copy(), q - lag, np.zeros(q.shape[1])
        for joint in self.joints:
            begun = 0
            for turned in (np.flatnonzero(np.diff(sides[:, joint])) + 1).tolist():
                before = stands[begun:turned, joint]
                turn = before.max() if sides[turned, joint] < 0 else before.min()
                away = np.flatnonzero(np.abs(before - turn) > self.near[joint])
                first = begun + (int(away[-1]) + 1 if len(away) else 0)
                part = slice(min(first, turned - 1), turned + 1)
                low, high = lag[part, joint][[0, -1]]
                share = (times[part] - times[part][0]) / np.ptp(times[part])
                share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
                made[part, joint] = stands[part, joint] + low + share * (high - low)
                if not first:
                    first_up[joint] = high - low
                begun = turned
        return made, self._longer_s(times, stands, first_up)

    def _longer_s(self, times: np.ndarray, stands: np.ndarray, first_up: np.ndarray) -> float:
        """For the first way to add little to the jerk of all by what is taken up in it."""
        span = self.model.arm.upper - self.model.arm.lower
        if not first_up.any() or len(times) < 3:
            return 0.0
        since, ways = times[1:], stands[1:] / span
        path, steps = Timed(since, ways, slopes_of(since, ways)), np.diff(since)
        jerk = float(((path.at(since[:-1] + 0.5 * steps, 3) ** 2).sum(axis=1) * steps).sum())
        # A cubic from rest to rest in a time t has a square of jerk of (12 / t^3)^2 t, of its way 1
        lasts = (144.0 * ((first_up / span) ** 2).sum() / max(_MORE_JERK * jerk, 1e-12)) ** 0.2
        return max(0.0, float(lasts - (times[1] - times[0])))


_MORE_JERK = 0.2
"""Share of a path's squared jerk that play taken up at its beginning may add: a tenth of its root
mean square."""
