"""Describes a discovered effect in words: a formula with units, and a physical cause like it."""

from collections.abc import Callable, Sequence
from math import floor, log10

from longarm_comp.core.arm.context import ORDER
from longarm_comp.core.effects.discovered import (
    BASE_PLACE,
    CAMERA,
    COMPONENTS,
    MEASURED,
    Discovered,
    DiscoveredView,
    Force,
    Give,
    Move,
    Turn,
    Weight,
    Wrench,
)
from longarm_comp.core.effects.quantities import (
    Gravity,
    JointLoad,
    JointPosition,
    JointSide,
    JointWay,
    LoadSum,
    Moment,
    Quantity,
    Recorded,
    Span,
    Warmth,
)
from longarm_comp.core.effects.shapes import Above, Below, Cosine, Shape, Sine, Switch

Found = Discovered | DiscoveredView


class _Traits:
    """The traits of discovered terms by which a physical cause like them is chosen."""

    def __init__(self, terms: Sequence[Found]) -> None:
        self.terms = terms
        self.shapes = [s for t in terms for s in t.of.factors]
        self.places = dict.fromkeys((t.at, t.component) for t in terms)
        self.columns = {s.of for s in self.shapes if isinstance(s.quantity, Recorded)}
        self.measured = any(t.at == CAMERA for t in terms)

    def of(self, *kinds: type[Quantity]) -> bool:
        """Tell whether a term depends on a quantity of one of these kinds."""
        return any(isinstance(s.quantity, kinds) for s in self.shapes)

    def shape(self, *kinds: type[Shape], of: tuple[type[Quantity], ...] = (Quantity,)) -> bool:
        """Tell whether a term has a shape of one of these kinds, of a quantity of these kinds."""
        return any(isinstance(s, kinds) and isinstance(s.quantity, of) for s in self.shapes)

    def acts(self, kind: type) -> bool:
        """Tell whether the components of all terms are of one kind."""
        return all(isinstance(COMPONENTS.get(t.component), kind) for t in self.terms)


_LOADS = (JointLoad, Moment, Gravity)
_READINGS: tuple[tuple[str, Callable[[_Traits], bool]], ...] = (
    ("an error of what is measured, not of the arm", lambda t: t.measured),
    (
        "a common supply that sags as the loads add up",
        lambda t: t.of(LoadSum) and len(t.places) > 1,
    ),
    ("play or friction", lambda t: t.of(JointSide)),
    ("rows that were measured before the arm stood", lambda t: t.of(JointWay)),
    ("a seat or clearance that flips with the load", lambda t: t.shape(Switch, of=_LOADS)),
    ("a spring or cable between the two places", lambda t: t.of(Span)),
    ("a contact, a stop or a taut cable", lambda t: t.shape(Above, Below)),
    ("something that happened between two poses", lambda t: ORDER in t.columns and t.shape(Switch)),
    ("a part that changes over at one position", lambda t: t.shape(Switch)),
    ("something thermal", lambda t: t.of(Warmth)),
    ("drift", lambda t: not {"t_s", ORDER}.isdisjoint(t.columns)),
    ("something that depends on the recorded column", lambda t: bool(t.columns)),
    ("a hose, chain or cable that is lifted", lambda t: t.acts(Weight) and t.of(JointPosition)),
    ("a mass that is not declared", lambda t: t.acts(Weight)),
    ("a soft part that yields under load", lambda t: t.acts(Give)),
    ("a hose or cable that pulls", lambda t: t.acts(Wrench) and t.of(JointPosition)),
    ("an eccentric gear, pulley or encoder", lambda t: t.shape(Cosine, Sine) and t.acts(Turn)),
    (
        "a soft part that yields under load",
        lambda t: t.acts(Turn) and t.of(JointLoad, Moment, LoadSum),
    ),
    ("an undeclared weight or spring", lambda t: t.acts(Force) and not t.shapes),
    ("a joint that does not turn as commanded", lambda t: t.acts(Turn)),
)
"""Physical causes in words, each with a test of traits; the most specific first."""


def reading(terms: Sequence[Found]) -> str:
    """Return a text on the physical cause that the terms together behave like."""
    traits = _Traits(terms)
    words = (f"behaves like {words}" for words, fits in _READINGS if fits(traits))
    return next(words, "no known cause")


def formula(terms: Sequence[Found], amounts: list[tuple[float, float, str]]) -> str:
    """Return terms as a formula, ``joint 5, force y: (24.2 +- 0.3) N/rad^2 x q2 x q5``.

    `amounts` are the value, standard error and unit of each term's amount.
    """
    by_place: dict[str, list[str]] = {}
    for term, (value, error, unit) in zip(terms, amounts, strict=True):
        size = f"({_round_to_error(value, error)}) {unit}".removesuffix(" 1")
        part = f"{size} x {term.of.formula}" if term.of.factors else size
        by_place.setdefault(term.where, []).append(part)
    return "; ".join(f"{place}: {' + '.join(parts)}" for place, parts in by_place.items())


def seen_alike(terms: Sequence[Found]) -> list[str]:
    """List the errors of the camera that would look the same as the terms.

    Terms that only move the base by recorded columns have one: a shift of all points.
    """
    traits = _Traits(terms)
    moved = all(t.at == BASE_PLACE and t.component.startswith(Move.word) for t in terms)
    recorded = all(isinstance(s.quantity, (Recorded, Warmth)) for s in traits.shapes)
    if not (moved and recorded and traits.shapes):
        return []
    axes = ", ".join(component.split(" ")[1] for _, component in traits.places)
    return [f"{MEASURED}, {axes}"]


def domain(terms: Sequence[Found]) -> list[str]:
    """List the range in the data of every quantity of the terms, as ``q2 0..0.52``."""
    shapes = (s for t in terms for s in t.of.factors)
    return list({s.of: f"{s.of} {s.low:.4g}..{s.high:.4g}" for s in shapes}.values())


def _round_to_error(value: float, error: float) -> str:
    """Return a value rounded to the digits that its standard error determines: ``24.2 +- 0.3``."""
    if not error > 0:
        return f"{value:.3g}"
    if abs(value) >= 1e5 or abs(value) < 1e-3:
        return f"{value:.3g} +- {error:.1g}"
    digits = max(-floor(log10(error)) + (f"{error:.0e}"[0] == "1"), 0)
    return f"{value:.{digits}f} +- {error:.{digits}f}"
