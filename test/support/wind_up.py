"""Joints that remember: springs that slip, whose sliders are dragged along the whole way."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.sim.context import State
from longarm_comp.sim.hidden.base import HiddenEffect

Array = np.ndarray


@dataclass(frozen=True)
class WindUp(HiddenEffect):
    """The joints stand behind their commands by what their past left (`State.behind`)."""

    name: ClassVar[str] = "friction_hysteresis"
    doses: ClassVar[tuple[str, ...]] = ()

    def joints(self, q: Array, state: State) -> Array:
        return q - state.behind


class Sliders:
    """K springs with dry friction in every joint (Jenkin elements), side by side.

    A slider stays where it is until the joint is farther from it than its reach; then the joint
    drags it along.  A joint stands behind by the share of each spring that is stretched.

    Args:
        reach: (K,) or (K, n) stretch at which a slider slips, rad or m.
        half: (K, n) lag at full stretch, rad or m.
        start: (n,) where the joints stand; the springs are slack.
    """

    def __init__(self, reach: Array, half: Array, start: Array) -> None:
        self._half = np.asarray(half, float)
        reach = np.asarray(reach, float)
        self._reach = np.broadcast_to(reach if reach.ndim == 2 else reach[:, None], half.shape)
        self._at = np.tile(np.asarray(start, float), (len(self._half), 1))
        self._joints = np.asarray(start, float)

    def drive(self, points: Array) -> None:
        """The joints go straight from way-point to way-point, (k, n)."""
        for point in np.atleast_2d(points):
            self._joints = np.asarray(point, float)
            self._at = np.clip(self._at, point - self._reach, point + self._reach)

    @property
    def behind(self) -> Array:
        """(n,) how far every joint stands behind its command."""
        return (self._half * (self._joints - self._at) / self._reach).sum(axis=0)


def there_and_back(arm: Arm, start: np.ndarray) -> np.ndarray:
    """(3, n) joints: to one end of every range, to the other, back: what they remember is known."""
    return np.stack([arm.lower, arm.upper, start])
