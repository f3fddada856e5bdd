"""What may change at an arm at work: every effect at every place, and where its numbers stand."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.catalogue import searched
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model, Slot, slots_of

Key = tuple[str, str]


@dataclass(frozen=True, eq=False)
class Parameters:
    """The numbers of a model and of all effects that may come to it, in one order.

    Attributes:
        absent: effects that it does not hold, at none.
        slots: of the model, then of these.
        keys: (C,) effect and place of every possible change.
        places: (C, k) positions of its numbers; -1 where it has fewer than k.
        log_prior: (C,) of it, given that something changes: what the model holds wears as often as
            something new appears; of each, every name is as likely as any other, and every place.
    """

    model: Model
    absent: tuple[Effect | Bias, ...]
    slots: tuple[Slot, ...]
    keys: tuple[Key, ...]
    places: np.ndarray
    log_prior: np.ndarray

    @classmethod
    def of(cls, model: Model, context: Context) -> Parameters:
        """Of a model, with every effect whose inputs the circumstances hold."""
        held = {term.key for term in model.terms}
        absent = tuple(t for k, t in _possible(model.arm, context).items() if k not in held)
        slots = (*model.slots, *slots_of(model.arm, absent))
        at: dict[Key, list[int]] = {}
        for k, slot in enumerate(slots):
            if slot.owner.searched and not slot.owner.geometry and not slot.owner.passing:
                at.setdefault(slot.owner.key, []).append(k)
        keys = tuple(at)
        places = np.full((len(keys), max(map(len, at.values()), default=0)), -1)
        for row, mine in enumerate(at.values()):
            places[row, : len(mine)] = mine
        return cls(model, absent, slots, keys, places, _log_prior(keys, held))

    def __len__(self) -> int:
        return len(self.slots)

    def own(self, c: int) -> list[int]:
        """Positions of the numbers of a possible change."""
        return [int(k) for k in self.places[c] if k >= 0]

    @cached_property
    def position(self) -> Mapping[tuple[object, ...], int]:
        """Of a slot by its identity."""
        return {slot.identity: k for k, slot in enumerate(self.slots)}

    def values(self, model: Model) -> np.ndarray:
        """(q,) as a model has them; 0 of what it does not hold."""
        made = np.zeros(len(self))
        made[[self.position[slot.identity] for slot in model.slots]] = model.values
        return made

    @cached_property
    def widths(self) -> np.ndarray:
        """(q,) ordinary sizes."""
        return np.array([s.parameter.prior for s in self.slots], dtype=float)

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(q,) lower and upper."""
        lower = np.array([s.parameter.lower for s in self.slots], dtype=float)
        return lower, np.array([s.parameter.upper for s in self.slots], dtype=float)

    def at(self, values: np.ndarray) -> Model:
        """The model with values (q,), and with those absent effects that are not at none."""
        values = np.clip(values, *self.bounds)
        count = len(self.model.slots)
        model = self.model.with_values(values[:count])
        given: dict[int, dict[str, float]] = {}
        for slot, value in zip(self.slots[count:], values[count:].tolist(), strict=True):
            if value != 0.0:
                given.setdefault(slot.term, {})[slot.parameter.name] = value
        return model.plus(*(self.absent[k].with_values(v) for k, v in given.items()))

    def columns(self, at: Model, q: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Predicted sighting (3,) m at joints (n,), and its derivative by every number, (3, q)."""
        held = {term.key for term in at.terms}
        rest = slots_of(at.arm, [t for t in self.absent if t.key not in held and _told(t, context)])
        slots = (*at.slots, *rest)
        point, columns = at.columns(at.posture(tuple(q.tolist()), context), slots)
        made = np.zeros((3, len(self)))
        made[:, [self.position[slot.identity] for slot in slots]] = columns.reshape(3, -1)
        return point.reshape(3), made


def _possible(arm: Arm, context: Context) -> dict[Key, Effect | Bias]:
    """One instance of every effect at every place, in the form that is tried first, at none.

    Of names that no sighting tells apart there is one.
    """
    made: dict[Key, Effect | Bias] = {}
    known = {kind.name for kind in searched()}
    for kind in (kind for kind in searched() if known.isdisjoint(kind.aliases)):
        for term in (t for group in kind.candidates(arm) for t in group):
            names = [p.name for p in term.parameters(arm)]
            if names and term.key not in made and _told(term, context):
                made[term.key] = dataclasses.replace(term, **dict.fromkeys(names, 0.0))
    return made


def _log_prior(keys: Sequence[Key], held: Collection[Key]) -> np.ndarray:
    """(C,) log probability of each possible change, given one."""
    names = Counter((key in held, key[0]) for key in keys)
    kinds = Counter(present for present, _ in names)
    each = [len(kinds) * kinds[key in held] * names[key in held, key[0]] for key in keys]
    return -np.log(each)


def _told(term: Effect | Bias, context: Context) -> bool:
    """Whether the circumstances hold what a term needs."""
    try:
        term.require(context)
    except InputError:
        return False
    return True
