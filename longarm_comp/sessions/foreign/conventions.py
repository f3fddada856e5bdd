"""Finds the convention of measured orientations: the one that fits the tip of the arm's model."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.belonging import SUSPECT_TURN, turn_error
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.foreign.units import CONVENTIONS, Rotation

_FEWEST = 10
"""Smallest number of rows: their thirty coordinates determine the nine unknowns of base and tool.
"""
_CLEAR = 2.0
"""A convention is clearly worse than the best if its error is above this many times the best."""


@dataclass(frozen=True)
class Conventions:
    """The misfit of each convention of rotations to an arm.

    Attributes:
        errors: mean angle (rad) between the arm's tip and the measured orientations, by
            convention as the user writes it (`Rotation.spelt`), the smallest first.
    """

    errors: Mapping[str, float]

    def refutes(self, rotation: Rotation) -> bool:
        """Tell whether the rows clearly follow another convention."""
        best = next(iter(self.errors))
        own = self.errors.get(rotation.spelt, np.inf)
        return self._is_clear and own > max(SUSPECT_TURN, _CLEAR * self.errors[best])

    @property
    def _is_clear(self) -> bool:
        return next(iter(self.errors.values())) < SUSPECT_TURN

    def describe(self, columns: str) -> str:
        """Say which conventions fit, with their error and that of the others; or that none does."""
        best, *others = self.errors.items()
        if not self._is_clear:
            return f"no convention fits (the best leaves {1e3 * best[1]:.3g} mrad)"
        alike = [best, *(other for other in others if other[1] < _CLEAR * best[1])]
        fit = " or ".join(f"{name}:{columns}" for name, _ in alike)
        rest = others[len(alike) - 1 :]
        left = f", others {1e3 * rest[0][1]:.3g} or more" if rest else ""
        return f"the rows fit {fit} (it leaves {1e3 * best[1]:.3g} mrad{left})"


def try_conventions(
    arm: Arm, q: np.ndarray, xyz: np.ndarray, labels: Mapping[str, np.ndarray], values: np.ndarray
) -> Conventions | None:
    """Compare measured orientations with the arm in each convention with as many columns.

    Args:
        q, xyz: (N, n) joints, rad and m; (N, 3) positions, m.
        labels: `group` and `marker` of the rows, if they have them.
        values: (N, 3, 4 or 9) numbers of the orientation, angles in rad.

    Returns:
        None if fewer than `_FEWEST` rows are complete, or no convention can be applied.
    """
    whole = np.isfinite(values).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if whole.sum() < _FEWEST:
        return None
    labels = {name: texts[whole] for name, texts in labels.items()}
    error = turn_error(Model(arm), Session.record(q[whole], xyz[whole], labels=labels))
    errors: dict[str, float] = {}
    for name in CONVENTIONS.get(values.shape[1], ()):
        for inverse in (False, True):
            tried = Rotation(name, (), inverse)
            try:
                errors[tried.spelt] = error(tried.quaternions(values[whole]))
            except ValueError:  # numbers that are no rotation in it
                continue
    return Conventions(dict(sorted(errors.items(), key=lambda each: each[1]))) if errors else None
