"""The possible changes of an arm at work: every effect at every place, and its parameters.

Of the geometry, a joint's zero may slip, alone or together with all others (as when the arm is
homed again), and the base or the tip may be knocked.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.linear import most_probable_within
from longarm_comp.core.calibration.model_fit import bounds_of
from longarm_comp.core.effects.catalogue import searched_effects
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.model.model import Model, Slot, slots_of

Key = tuple[str, str]
TOGETHER = "all joints"
"""The place of a change of the zeros of all joints at once."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """The parameters of a model and of all effects that may be added to it, in one order.

    Attributes:
        absent: the effects that may be added, with all values 0.
        slots: the parameters of the model, then those of `absent`.
        keys: (C,) effect and place of every possible change.
        places: (C, k) positions in `slots` of the parameters of each change; -1 fills up rows of
            changes with fewer than k.
        log_prior: (C,) log probability of each change, given that something changes. An effect of
            the model is as likely to change as a new one is to appear. Within either group every
            effect name is equally likely, and so is every place of one name.
    """

    model: Model
    absent: tuple[Effect | Bias, ...]
    slots: tuple[Slot, ...]
    keys: tuple[Key, ...]
    places: np.ndarray
    log_prior: np.ndarray

    @classmethod
    def of(cls, model: Model, context: Context) -> Parameters:
        """List the parameters of a model, and of every effect whose inputs the circumstances hold.

        An effect that the model lacks has the form that is tried first.  If no sighting can tell
        two effects apart, only one of them is listed.
        """
        present = {term.key for term in model.terms}
        possible: dict[Key, Effect | Bias] = {}
        known = {kind.name for kind in searched_effects()}
        for kind in (kind for kind in searched_effects() if known.isdisjoint(kind.aliases)):
            for term in (t for group in kind.candidates(model.arm) for t in group):
                names = [p.name for p in term.parameters(model.arm)]
                if names and term.key not in possible and _has_inputs(term, context):
                    possible[term.key] = dataclasses.replace(term, **dict.fromkeys(names, 0.0))
        absent = tuple(term for key, term in possible.items() if key not in present)
        slots = (*model.slots, *slots_of(model.arm, absent))
        at: dict[Key, list[int]] = {}
        for k, slot in enumerate(slots):
            owner = slot.owner
            wears = owner.searched and not owner.geometry and not owner.passing
            if wears or owner.slips or owner.knocked:
                at.setdefault(slot.owner.key, []).append(k)
            if owner.slips:
                at.setdefault((owner.name, TOGETHER), []).append(k)
        keys = tuple(at)
        places = np.full((len(keys), max(map(len, at.values()), default=0)), -1)
        for row, mine in enumerate(at.values()):
            places[row, : len(mine)] = mine
        alike = Counter((key in present, key[0]) for key in keys)
        kinds = Counter(held for held, _ in alike)
        each = [len(kinds) * kinds[k in present] * alike[k in present, k[0]] for k in keys]
        return cls(model, absent, slots, keys, places, -np.log(each))

    def __len__(self) -> int:
        return len(self.slots)

    @cached_property
    def knocks(self) -> np.ndarray:
        """(C,) bool: changes that a knock may cause, of the arm or of what measures it."""
        return np.array([self.slots[own[0]].owner.knocked for own in self.places.tolist()], bool)

    def own(self, c: int) -> list[int]:
        """Return the positions in `slots` of the parameters of possible change c."""
        return [int(k) for k in self.places[c] if k >= 0]

    def where(self, c: int) -> str:
        """Return the place of possible change c in words."""
        return TOGETHER if TOGETHER in self.keys[c] else self.slots[self.own(c)[0]].owner.where

    @cached_property
    def position(self) -> Mapping[tuple[object, ...], int]:
        """The position in `slots` of each parameter, by the slot's identity."""
        return {slot.identity: k for k, slot in enumerate(self.slots)}

    def values(self, model: Model) -> np.ndarray:
        """Return the (q,) values of all parameters in a model; 0 for effects that it lacks."""
        made = np.zeros(len(self))
        made[[self.position[slot.identity] for slot in model.slots]] = model.values
        return made

    @cached_property
    def widths(self) -> np.ndarray:
        """Prior standard deviations of the parameters, (q,)."""
        return np.array([s.parameter.prior for s in self.slots], dtype=float)

    @cached_property
    def bounds(self) -> np.ndarray:
        """Lower and upper bounds of the parameters, (2, q)."""
        return bounds_of(self.slots)

    def most_probable(
        self, mean: np.ndarray, active: np.ndarray, covariance: np.ndarray
    ) -> np.ndarray:
        """Return the most probable values (q,) within the bounds of the parameters.

        Args:
            mean: (q,) mean of the parameters.
            active: (p,) positions of the parameters that are not known exactly.
            covariance: (p, p) of the active parameters.
        """
        lower, upper = self.bounds
        made = np.clip(mean, lower, upper)
        made[active] = most_probable_within(mean[active], covariance, lower[active], upper[active])
        return made

    def at(self, values: np.ndarray) -> Model:
        """Build the model with parameter values (q,), without `absent` effects that are all 0."""
        values = np.clip(values, *self.bounds)
        count = len(self.model.slots)
        model = self.model.with_values(values[:count])
        given: dict[int, dict[str, float]] = {}
        for slot, value in zip(self.slots[count:], values[count:].tolist(), strict=True):
            if value != 0.0:
                given.setdefault(slot.term, {})[slot.parameter.name] = value
        return model.plus(*(self.absent[k].with_values(v) for k, v in given.items()))

    def columns(self, at: Model, q: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Predict a sighting (3,), m, and its derivatives (3, q) by the parameters.

        Args:
            at: the model to linearise.
            q: (n,) commanded joints, rad and m.
            context: circumstances, with the history of the joints.
        """
        present = {term.key for term in at.terms}
        rest = [t for t in self.absent if t.key not in present and _has_inputs(t, context)]
        slots = (*at.slots, *slots_of(at.arm, rest))
        point, columns = at.columns(at.posture(tuple(q.tolist()), context), slots)
        made = np.zeros((3, len(self)))
        made[:, [self.position[slot.identity] for slot in slots]] = columns.reshape(3, -1)
        return point.reshape(3), made


def _has_inputs(term: Effect | Bias, context: Context) -> bool:
    """Tell whether the circumstances hold everything that a term reads."""
    return not term.missing(context) and all(map(context.has, term.needs))
