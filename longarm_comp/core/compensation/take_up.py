"""Play along a path: what joints stand behind their commands by, and when it is taken up.

Where a joint turns, its command has to cross its play while the joint stands still.  In one step
that is a kick.  As long as the joint as planned stays near its turn, though, it may as well stand:
the play is taken up smoothly over that time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import SAME_POSE, History
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
        if not self.joints:
            return behind
        held = [(effect, effect.history_joints(arm)) for effect in self.model.effects]
        held = [(effect, joints) for effect, joints in held if joints]
        loaded = any(effect.loaded for effect, _ in held)
        posture = (self.model.unsagged if loaded else self.model.unplaced)(unstack(q), context)
        for effect, joints in held:
            twists = effect.twists(posture)
            for joint in joints:
                row = arm.commanded[joint]
                if twist := twists.get(posture.bearing(row)):
                    behind[:, joint] -= twist[2 if arm.joints[row - 1].type == "prismatic" else 5]
        return behind

    def came(
        self, stands: np.ndarray, lag: np.ndarray, held: History, start: np.ndarray | None
    ) -> History:
        """Of commands at which joints stand at (k, n), lag (k, n) behind; first from a start (n,).

        A joint's side is that of its own way: what its command crosses where it turns is no way
        back.  A joint that turns on the first way, while near where it starts, turns at once.
        """
        steady = self.steady(stands)
        came = held.along(steady + lag, start)
        moves = np.diff(steady, axis=0, prepend=steady[:1])
        last = np.where(np.abs(moves) >= SAME_POSE, np.arange(len(moves))[:, None], 0)
        last = np.maximum.accumulate(last, axis=0)
        sides = np.sign(np.take_along_axis(moves, last, axis=0))
        sides, each = np.where(last > 0, sides, came.approach[0]), np.arange(sides.shape[1])
        turned = np.argmax(sides != sides[0], axis=0)
        before = np.arange(len(sides))[:, None] < turned
        at_once = (~before | (np.abs(stands - stands[0]) <= self.near)).all(axis=0)
        at_once &= np.isin(each, self.joints)
        before[0] = False
        then = before & at_once
        sides = np.where(then, sides[turned, each], sides)
        legs = np.where(then[..., None], came.legs[turned, each], came.legs)
        return History(sides, legs)

    def turns(self, stands: np.ndarray, lag: np.ndarray, sides: np.ndarray) -> list[Turn]:
        """Where joints that stand at (k, n) turn: their sides (k, n) change where they have."""
        found = []
        for joint in self.joints:
            begun = 0
            for turned in (np.flatnonzero(np.diff(sides[:, joint])) + 1).tolist():
                before = stands[begun:turned, joint]
                turn = before.max() if sides[turned, joint] < 0 else before.min()
                away = np.flatnonzero(np.abs(before - turn) > self.near[joint])
                first = min(begun + (int(away[-1]) + 1 if len(away) else 0), turned - 1)
                crossed = float(lag[turned, joint] - lag[first, joint])
                found.append(Turn(joint, first, turned, crossed))
                begun = turned
        return found


class Turn(NamedTuple):
    """From the ``first`` to the ``last`` way-point a joint stands near its turn (0-based).

    Its command crosses so much play (rad, m) there.
    """

    joint: int
    first: int
    last: int
    crossed: float


def taken_up(
    way: np.ndarray, off: np.ndarray, lag: np.ndarray, turns: Sequence[Turn], times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where joints stand at times (k,), and how far commands are beyond: (k, n) each.

    They are smooth in time from one side of the play to the other.

    Args:
        way: (k, n) where joints would stand if none turned.
        off: (k, n) how much further they have to stand, which the play itself changes a little.
    """
    off, lag = off.copy(), lag.copy()
    for joint, first, last, crossed in turns:
        part = slice(first, last + 1)
        share = (times[part] - times[first]) / (times[last] - times[first])
        share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        lag[part, joint] = lag[first, joint] + share * crossed
        off[part] = off[first] + np.multiply.outer(share, off[last] - off[first])
    return way + off, lag
