"""What an effect may need besides q: approach direction, temperature, time, payload, tilt.

History lives here, derived once from the order of the samples, so that every effect
stays a pure function of a posture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import Scalar, Vec
from longarm_comp.core.errors import InputError


@dataclass(frozen=True)
class Context:
    """Recorded circumstances of one posture, or of N (scalars are then (N,) arrays).

    Attributes:
        approach: per joint -1, 0 (unknown) or +1: the side it arrived from, n scalars;
            empty when unknown.
        travel: per joint the signed way since it last turned round (rad, m), n scalars;
            0 or empty when unknown.
        columns: any further quantity by name: `temperature_c`, `payload_kg`, `t_s`,
            `incl_<frame>_x`, ... (SI but for the degrees Celsius).
        labels: text columns such as `group` and `marker`, one string or (N,) array of them.
    """

    approach: tuple[Scalar, ...] = ()
    columns: Mapping[str, Scalar] = field(default_factory=dict)
    labels: Mapping[str, object] = field(default_factory=dict)
    travel: tuple[Scalar, ...] = ()

    def has(self, name: str) -> bool:
        """Whether an input was recorded."""
        return bool(self.approach) if name == "approach" else name in self.columns

    def column(self, name: str, default: float | None = None) -> Scalar:
        """A recorded quantity.

        Raises:
            InputError: it was not recorded and there is no default.
        """
        if name in self.columns:
            return self.columns[name]
        if default is None:
            known = ", ".join(sorted(self.columns)) or "none"
            raise InputError("context", name, "missing", f"a recorded column (there are: {known})")
        return default

    def vector(self, names: tuple[str, str, str]) -> Vec:
        """Three recorded quantities."""
        return (self.column(names[0]), self.column(names[1]), self.column(names[2]))

    def payload_kg(self, declared: float) -> Scalar:
        """Carried mass: recorded, else as declared."""
        return self.column("payload_kg", declared)

    def direction(self, joint: int) -> Scalar:
        """Side (-1, 0, +1) that commanded joint number `joint` (0-based) arrived from."""
        return self.approach[joint] if self.approach else 0.0

    def way(self, joint: int) -> Scalar:
        """Signed way (rad, m) of commanded joint number `joint` since it last turned round."""
        return self.travel[joint] if self.travel else 0.0

    def is_label(self, name: str, value: str) -> Scalar:
        """1.0 where a text column holds `value`, else 0.0; 1.0 when there is no such column."""
        if name not in self.labels:
            return 1.0
        held = self.labels[name]
        if isinstance(held, str):
            return 1.0 if held == value else 0.0
        return (np.asarray(held) == value).astype(float)

    def take(self, rows: np.ndarray | slice | int) -> Context:
        """The context of some of N postures; what is one scalar for all stays so."""

        def of(value: Any) -> Any:
            return value[rows] if np.ndim(value) else value

        return Context(
            tuple(of(a) for a in self.approach),
            {name: of(v) for name, v in self.columns.items()},
            {name: of(v) for name, v in self.labels.items()},
            tuple(of(a) for a in self.travel),
        )

    @classmethod
    def empty(cls) -> Context:
        """Nothing recorded."""
        return cls()
