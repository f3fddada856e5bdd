"""The free parameters of a model, each with the term that holds it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.effect import Bias, Effect, Parameter


@dataclass(frozen=True)
class Slot:
    """One parameter of a model: its term and the parameter of that term."""

    term: int
    owner: Effect | Bias
    parameter: Parameter

    @cached_property
    def identity(self) -> tuple[object, ...]:
        """Key of the parameter: effect, place, form and name."""
        return (self.owner.name, *self.owner.placement.items(), self.parameter.name)

    @property
    def label(self) -> str:
        """A name for people, such as ``joint_compliance / joint 2 / compliance``."""
        return f"{self.owner.name} / {self.owner.place} / {self.parameter.name}"

    @property
    def value(self) -> float:
        return float(getattr(self.owner, self.parameter.name))

    @property
    def step(self) -> float:
        """A small change of the parameter, for differences: 1 % of its prior."""
        return 0.01 * self.parameter.prior

    @cached_property
    def ends(self) -> tuple[Any, Any]:
        """The term with the parameter a step higher, and with it a step lower."""
        name, term = self.parameter.name, self.owner
        up, down = self.value + self.step, self.value - self.step
        return term.with_values({name: up}), term.with_values({name: down})


def slots_of(arm: Arm, terms: Sequence[Effect | Bias]) -> tuple[Slot, ...]:
    """Return the free parameters of some terms."""
    every = ((t, term, p) for t, term in enumerate(terms) for p in term.parameters(arm))
    return tuple(Slot(t, term, p) for t, term, p in every if p.prior > 0)
