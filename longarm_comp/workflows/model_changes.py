"""Lists what changes from one model of an arm to another, in words and by its size at the tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.effects.units import for_people
from longarm_comp.core.model.model import Model

GEOMETRY, CAMERA = "geometry", "camera"


@dataclass(frozen=True)
class ModelChange:
    """One effect of the new model that the old one lacks, or has with other values.

    Attributes:
        what, where: canonical name of the effect, and its place. `geometry` and `camera`, without a
            place, stand for all effects of the geometry and of the measuring side.
        kind: ``added``, ``changed`` or ``removed``.
        values: (parameter, unit, before, after) of each changed parameter; NaN where the effect is
            missing.
        tip_mm: RMS displacement (3-D) of the measured tip by this change, over the given poses.
    """

    what: str
    where: str
    kind: str
    values: tuple[tuple[str, str, float, float], ...]
    tip_mm: float

    def __str__(self) -> str:
        place = f" at {self.where}" if self.where else ""
        shown = []
        for name, unit, *values in self.values:
            times, read = for_people(unit)
            before, after = ("none" if np.isnan(v) else f"{times * v:.4g}" for v in values)
            shown.append(f"{name} {before} -> {after} {read}")
        listed = f" ({', '.join(shown)})" if shown else ""
        return f"{self.what}{place} {self.kind}: {self.tip_mm:.3f} mm at the tip{listed}"


def list_changes(
    before: Model, after: Model, q: np.ndarray, context: Context | None
) -> list[ModelChange]:
    """List the changes from one model to another of the same arm, the largest first.

    The size of a change is the displacement of the tip when it alone is taken back from the new
    model, at joints q (N, n), rad and m. Changes that hardly move the tip are left out.
    """
    old, new = ({(t.name, t.place): t for t in model.terms} for model in (before, after))
    differing: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for key in dict.fromkeys((*new, *old)):
        if old.get(key) != new.get(key):
            term = new.get(key) or old[key]
            together = CAMERA if isinstance(term, Bias) else GEOMETRY if term.geometry else ""
            differing.setdefault((together, "") if together else key, []).append(key)
    seen = after.measured(q, context)
    found = []
    for (name, _), keys in differing.items():
        terms = {key: new[key] for key in new if key not in keys}
        terms |= {key: old[key] for key in keys if key in old}
        moved = after.with_terms(list(terms.values())).measured(q, context) - seen
        tip_mm = 1e3 * float(np.sqrt((moved**2).sum(axis=1).mean()))
        # A change that moves the tip by less than this is not reported
        if tip_mm < 5e-4:
            continue
        if name in (GEOMETRY, CAMERA):
            found.append(ModelChange(name, "", "changed", (), tip_mm))
            continue
        was, now = old.get(keys[0]), new.get(keys[0])
        kind = "added" if was is None else "removed" if now is None else "changed"
        term, values = now or old[keys[0]], []
        for p in term.parameters(after.arm):
            a, b = (np.nan if t is None else float(getattr(t, p.name)) for t in (was, now))
            # Relative difference of two values that counts as none
            if not np.isclose(a, b, rtol=1e-9, atol=0.0):
                values.append((p.name, p.unit, a, b))
        found.append(ModelChange(name, term.where, kind, tuple(values), tip_mm))
    return sorted(found, key=lambda change: -change.tip_mm)
