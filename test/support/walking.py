"""How an arm of a test's own moves: fast, but never as nodes refuse to believe (`JointTrust`)."""

from collections.abc import Iterable

import numpy as np

from longarm_comp.core.arm.arm import Arm

STEP = 0.09
"""Share of a joint's range that is gone at once: however soon it comes, it is not doubted."""


class Walk:
    """Where an arm stands, and the way that lies ahead of it.

    Attributes:
        q: joints (n,) where it stands now.
        ahead: joints (n,) that it takes next, one after another.
    """

    def __init__(self, arm: Arm, q: np.ndarray | None = None) -> None:
        self._step = STEP * (arm.upper - arm.lower)
        self.q, self.ahead = arm.mid.copy() if q is None else q, list[np.ndarray]()

    def go(self, way: Iterable[np.ndarray]) -> None:
        """Leave what lies ahead for a way of joints (n,), straight from one to the next."""
        at, ahead = self.q, list[np.ndarray]()
        for end in map(np.asarray, way):
            count = max(1, int(np.ceil(np.max(np.abs(end - at) / self._step))))
            ahead += list(np.linspace(at, end, count + 1)[1:])
            at = end
        self.ahead = ahead

    def step(self) -> bool:
        """Take the next step; whether there was one."""
        if self.ahead:
            self.q = self.ahead.pop(0)
            return True
        return False
