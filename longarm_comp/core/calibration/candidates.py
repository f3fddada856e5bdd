"""The candidates of a diagnosis: each effect in each form, at single places and at all together."""

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.catalogue import searched_effects
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Slot, slots_of

Term = Effect | Bias
NO_PLACE = "the declared arm has no place for it"
"""The reason why an effect without a place on the declared arm is not testable."""


@dataclass(frozen=True)
class Candidate:
    """A possible cause: some terms of one effect, in one form.

    Attributes:
        name: name of the effect.
        terms: its instances, which are fitted together.
        scanned: whether its form was found by a scan of the residual instead of listed by its
            class.
    """

    name: str
    terms: tuple[Term, ...]
    scanned: bool = False

    @property
    def where(self) -> tuple[str, ...]:
        """The places of its terms, each once."""
        return tuple(dict.fromkeys(t.where for t in self.terms))

    @property
    def form(self) -> tuple[tuple[str, object], ...]:
        """The form fields, shared by all terms."""
        return tuple(self.terms[0].forms.items())

    @property
    def label(self) -> str:
        """A text for people: ``backlash (joint 2, gate=0.15, blend=0.167)``."""
        form = ", ".join(f"{k}={v:g}" if isinstance(v, float) else f"{k}={v}" for k, v in self.form)
        return f"{self.name} ({', '.join(self.where)}{', ' + form if form else ''})"

    def slots(self, arm: Arm) -> tuple[Slot, ...]:
        """Return the parameters of its terms that are fitted on an arm."""
        return slots_of(arm, self.terms)


@dataclass(frozen=True)
class Library:
    """The candidates that the data can test, and those that they cannot.

    Attributes:
        testable: candidates whose inputs were recorded and varied.
        not_testable: name of each other effect, and the reason.
        stepped: effects whose steps may be scanned.
    """

    testable: tuple[Candidate, ...]
    not_testable: tuple[tuple[str, str], ...]
    stepped: tuple[type[Effect], ...] = ()


def list_candidates(
    arm: Arm,
    context: Context,
    kinds: Sequence[type[Effect] | type[Bias]] | None = None,
    declared: Sequence[Term] = (),
) -> Library:
    """List each form of each effect, at every single place and at all places together.

    An effect is not testable if an input of it was not recorded or never changed, or if it has no
    place on the arm.

    Args:
        arm: determines the places.
        context: the recorded inputs.
        kinds: the effects to try; by default `searched_effects`.
        declared: terms that the model holds already; they are never added twice.
    """
    known = {(t.name, t.where) for t in declared}
    testable: list[Candidate] = []
    missing: list[tuple[str, str]] = []
    tried = searched_effects() if kinds is None else kinds
    for kind in tried:
        if issubclass(kind, Bias) and not kind.of_instrument(arm):
            missing.append((kind.name, f"positions are measured by {arm.measuring}"))
            continue
        groups = kind.candidates(arm)
        if not groups:
            missing.append((kind.name, NO_PLACE))
            continue
        why = ""
        usable: list[Candidate] = []
        for group in groups:
            if any((t.name, t.where) in known for t in group):
                why = why or "already in the model"
                continue
            try:
                for term in group:
                    term.require(context)
                    for name in term.inputs:
                        column = context.columns.get(name)
                        if column is not None and np.ptp(np.asarray(column)) == 0.0:
                            value = f"{np.ravel(column)[0]:g} in all rows"
                            raise InputError(term.name, name, value, "a column that changes")
            except InputError as error:
                why = f"{error.field} is {error.value}; needed: {error.allowed}"
                continue
            usable.append(Candidate(kind.name, tuple(group)))
        if not usable:
            missing.append((kind.name, why))
        testable += usable + _join_places(usable)
    stepped = tuple(kind for kind in tried if issubclass(kind, Effect) and kind.stepped)
    return Library(tuple(testable), tuple(missing), stepped)


def list_variants(terms: Iterable[Term]) -> tuple[object, ...]:
    """Return a key for terms: effect, place and form of each, without the parameters' values."""
    return tuple(t.variant for t in terms)


def distinct_terms(
    candidates: Iterable[Candidate], but: Container[tuple[str, str]] = ()
) -> tuple[Term, ...]:
    """Return each term of the candidates once, except the terms with some keys.

    Args:
        but: these keys (name and place).
    """
    made: dict[tuple[object, ...], Term] = {}
    for candidate in candidates:
        for term in candidate.terms:
            if term.key not in but:
                made.setdefault(term.variant, term)
    return tuple(made.values())


def _join_places(singles: list[Candidate]) -> list[Candidate]:
    """Return a candidate of all places together for each form of an effect with several places."""
    by_form: dict[tuple[tuple[str, object], ...], list[Term]] = {}
    for c in singles:
        if len(c.terms) == 1:
            by_form.setdefault(c.form, []).append(c.terms[0])
    known = {(len(c.terms), c.form) for c in singles}
    return [
        Candidate(terms[0].name, tuple(terms))
        for form, terms in by_form.items()
        if len(terms) > 1 and (len(terms), form) not in known
    ]
