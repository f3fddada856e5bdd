"""A direction in which arms of one kind differ."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.spatial import Twist
from longarm_comp.core.effects.effect import Effect, Posture, Twists, form, parameter, place


@dataclass(frozen=True)
class KindDirection(Effect):
    """What other arms of the kind share: errors that come together, with one free amount.

    It is fitted in the place of a correlated prior (`core/identify/kind_of_arm.py`) and then
    folded into the errors that it is made of.  No model.yaml holds it.
    """

    name = "kind_direction"
    title = "usual difference between arms of this kind"
    geometry = True
    passing = True
    searched = False

    number: int = place()
    terms: tuple[Effect, ...] = form(())  # type: ignore[arg-type]
    amount: float = parameter("", "amount, in standard deviations among the arms", 1.0)

    @property
    def loaded(self) -> bool:  # type: ignore[override]
        return any(term.loaded for term in self.terms)

    def twists(self, posture: Posture) -> Twists:
        """The twists of its parts, which are linear in their values, times the amount."""
        made: dict[int, Twist] = {}
        for term in self.terms:
            for station, twist in term.twists(posture).items():
                grown: Twist = tuple(self.amount * v for v in twist)  # type: ignore[assignment]
                held = made.get(station)
                made[station] = grown if held is None else spatial.add_twists(held, grown)
        return made
