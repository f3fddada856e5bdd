"""A change of the arm with its name, its place and its size, as it is reported and stored."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.at_work.explanations import Explanations
from longarm_comp.core.yaml_file import Declared


class Named(Declared):
    """A change: its place, and the most probable effect there.

    Attributes:
        since_s: time of the first sighting that shows it.
        by: (parameter, unit, change) of the parameters that changed. If several joints are
            concerned, the parameter's name begins with its joint.
        probability: probability of the effect, given that something changed there.
        rivals: other effects there that may have changed, with their probabilities.
        sightings: number of sightings that it took to find the change.
    """

    effect: str
    where: str
    since_s: float
    by: tuple[tuple[str, str, float], ...]
    probability: float
    rivals: tuple[tuple[str, float], ...]
    sightings: int

    @property
    def text(self) -> str:
        """The change in one line: ``backlash (61 %) or servo_droop (39 %), joint 2: width +0.0031
        rad``."""
        each = ((self.effect, self.probability), *self.rivals)
        names = " or ".join(f"{name} ({100 * p:.0f} %)" for name, p in each)
        by = ", ".join(f"{name} {value:+.2g} {unit}" for name, unit, value in self.by)
        return f"{names}, {self.where}: {by}"


def name_change(known: Explanations, where: str) -> Named:
    """Describe the change at a place by the effect that has most probably changed there."""
    here = [(b, c) for b in known.branches for c in b.changes if c.where == where]
    whole = sum(b.weight for b, _ in here)
    chances: dict[str, float] = {}
    for branch, change in here:
        name = change.key[0]
        chances[name] = chances.get(name, 0.0) + branch.weight / whole
    first, *others = sorted(chances, key=lambda name: -chances[name])
    branch, change = next((b, c) for b, c in here if c.key[0] == first)
    space = branch.known.space
    places = space.own(space.keys.index(change.key))
    moved = branch.known.expected[places] - np.array(change.before)
    slots = [space.slots[k] for k in places]
    several = len({s.owner.where for s in slots}) > 1
    by = tuple(
        (
            f"{s.owner.where} {s.parameter.name}" if several else s.parameter.name,
            s.parameter.unit,
            v,
        )
        for s, v in zip(slots, moved.tolist(), strict=True)
        if v
    )
    return Named(
        effect=first,
        where=where,
        since_s=change.since_s,
        by=by,
        probability=chances[first],
        rivals=tuple((name, chances[name]) for name in others),
        sightings=change.sightings,
    )
