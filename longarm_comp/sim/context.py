"""Circumstances in which the simulated arm stands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Context:
    """Circumstances of N postures; what is None is as declared, or not known.

    Attributes:
        approach: side each joint arrived from, (N, n) of -1, 0, +1.
        temperature_c: (N,) degrees Celsius.
        payload_kg: carried mass, (N,).
        t_s: time since the session began, (N,).
    """

    approach: Array | None = None
    temperature_c: Array | float | None = None
    payload_kg: Array | float | None = None
    t_s: Array | float | None = None

    def filled(self, postures: int, joints: int, temperature_c: float, payload_kg: float) -> Context:
        """The same with every field an array of N rows."""

        def column(value: Array | float | None, otherwise: float) -> Array:
            return np.broadcast_to(otherwise if value is None else value, (postures,)).astype(float)

        approach = np.zeros(joints) if self.approach is None else self.approach
        return replace(
            self,
            approach=np.broadcast_to(approach, (postures, joints)).astype(float),
            temperature_c=column(self.temperature_c, temperature_c),
            payload_kg=column(self.payload_kg, payload_kg),
            t_s=column(self.t_s, 0.0),
        )
