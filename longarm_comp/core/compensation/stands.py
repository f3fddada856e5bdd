"""Where the tip stands by the readings of the joints, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.expected import ExpectedMiss, expected_miss
from longarm_comp.core.model.by_readings import by_readings
from longarm_comp.core.model.model import Model


@dataclass(frozen=True, eq=False)
class TipByReadings:
    """The tip (3,), m, and what is not known of it."""

    tip: np.ndarray
    doubt: ExpectedMiss

    def said(self, target: np.ndarray | None = None) -> str:
        """In one sentence: where it stands, or how far from a target (3,), m."""
        within = f", within {1e3 * self.doubt.p90_m:.2f} mm" if self.doubt.p90_m > 0 else ""
        if target is not None:
            off = 1e3 * float(np.linalg.norm(self.tip - target))
            return f"by the readings the tip is {off:.2f} mm from the target{within}"
        where = ", ".join(f"{1e3 * v:.2f}" for v in self.tip)
        return f"by the readings the tip is at {where} mm{within}"


def tip_by_readings(model: Model, readings: np.ndarray, context: Context) -> TipByReadings:
    """Where the tip stands by readings (n,), rad and m; the model is that of the commands."""
    arm = by_readings(model)
    tip = arm.tip(readings, context)
    return TipByReadings(tip, expected_miss(arm, readings, context, tip))
