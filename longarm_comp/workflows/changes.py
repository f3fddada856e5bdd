"""What a new version of a model changed: which values, and what each means at the tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.model.model import Model

Term = Effect | Bias
Key = tuple[str, str]
Value = tuple[str, str, float, float]
GEOMETRY, CAMERA = "geometry", "camera"


@dataclass(frozen=True)
class Change:
    """One effect of the new version that the old one lacks, or has with other values.

    Attributes:
        what: canonical name of the effect; `geometry` and `camera` stand for all of their terms.
        where: its place; empty for these two.
        kind: ``added``, ``changed`` or ``removed``.
        values: (parameter, unit, before, after), NaN where it was or is not there.
        tip_mm: RMS of what it moves the seen tip by, 3-D, over the poses given.
    """

    what: str
    where: str
    kind: str
    values: tuple[Value, ...]
    tip_mm: float

    def __str__(self) -> str:
        """In one line."""
        place = f" at {self.where}" if self.where else ""
        shown = [
            f"{name} {_number(before)} -> {_number(after)} {unit}".rstrip()
            for name, unit, before, after in self.values
        ]
        listed = f" ({', '.join(shown)})" if shown else ""
        return f"{self.what}{place} {self.kind}: {self.tip_mm:.3f} mm at the tip{listed}"


def changes(before: Model, after: Model, q: np.ndarray, context: Context | None) -> list[Change]:
    """What changed from one model to another of the same arm, largest at the tip first.

    Each change is judged by itself at joints q (N, n), rad and m: the new model against the new
    model without this change. One that does not move the tip is left out.
    """
    old, new = ({(t.name, t.place): t for t in model.terms} for model in (before, after))
    seen = after.measured(q, context)
    found = []
    for group in _groups(old, new):
        terms = {key: new[key] for key in new if key not in group}
        terms |= {key: old[key] for key in group if key in old}
        moved = after.with_terms(list(terms.values())).measured(q, context) - seen
        first = new.get(group[0]) or old[group[0]]
        single = len(group) == 1 and _name(first) == first.name
        values: tuple[Value, ...] = ()
        where, kind = "", "changed"
        if single:
            where, values = first.where, _values(old.get(group[0]), new.get(group[0]), after)
            kind = "added" if group[0] not in old else "changed" if group[0] in new else "removed"
        tip_mm = 1e3 * float(np.sqrt((moved**2).sum(axis=1).mean()))
        found.append(Change(_name(first), where, kind, values, tip_mm))
    # A change that moves the tip by less than this is not reported
    felt = (change for change in found if change.tip_mm >= 5e-4)
    return sorted(felt, key=lambda change: -change.tip_mm)


def _groups(old: dict[Key, Term], new: dict[Key, Term]) -> list[list[Key]]:
    """Keys of the terms that differ; geometry and camera together, every effect by itself."""
    together: dict[str, list[Key]] = {}
    for key in dict.fromkeys((*new, *old)):
        if old.get(key) != new.get(key):
            name = _name(new.get(key) or old[key])
            whole = name in (GEOMETRY, CAMERA)
            together.setdefault(name if whole else "/".join(key), []).append(key)
    return list(together.values())


def _name(term: Term) -> str:
    if isinstance(term, Bias):
        return CAMERA
    return GEOMETRY if term.geometry else term.name


def _values(old: Term | None, new: Term | None, model: Model) -> tuple[Value, ...]:
    rows = []
    for p in (new or old).parameters(model.arm):  # type: ignore[union-attr]
        was, now = (np.nan if t is None else float(getattr(t, p.name)) for t in (old, new))
        # Relative difference of two values that counts as none
        if not np.isclose(was, now, rtol=1e-9, atol=0.0):
            rows.append((p.name, p.unit, was, now))
    return tuple(rows)


def _number(value: float) -> str:
    return "none" if np.isnan(value) else f"{value:.4g}"
