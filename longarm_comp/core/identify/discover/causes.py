"""Causes without a name: the functions that were found, in words and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.effects.discovered import CAMERA
from longarm_comp.core.identify.discover import words
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.posterior.found import CREDIBLE, FoundEffect


@dataclass(frozen=True)
class Coefficient:
    """One fitted coefficient: value, 95 % interval and unit."""

    where: str
    function: str
    value: float
    ci95: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Cause:
    """One cause without a name.

    Attributes:
        terms: as the model holds them.
        where: places that explain it alike; the first is the one in the model.
        names: effects of the library that may be the cause instead, with their probability.
        formula: place, component and function with units.
        reading: what it behaves like.
        domain: range of each quantity in the data; outside, it counts as at the end.
        inputs: names of these quantities.
        amounts: the coefficients.
        log_evidence: on top of the rest.
        probability: that it, or what it cannot be told from, is there.
        tip_m: rms and largest shift of the tip over the fitted rows.
        compensated: whether commands correct for it; never what the camera alone sees.
    """

    terms: tuple[words.Found, ...]
    where: tuple[str, ...]
    names: tuple[tuple[str, float], ...]
    formula: str
    reading: str
    domain: tuple[str, ...]
    inputs: tuple[str, ...]
    amounts: tuple[Coefficient, ...]
    log_evidence: float
    probability: float
    tip_m: tuple[float, float]
    compensated: bool

    @property
    def sentence(self) -> str:
        """The formula, what it amounts to, and what it behaves like."""
        rms, most = (1e3 * v for v in self.tip_m)
        text = f"{self.formula} ({rms:.2f} mm rms at the tip, at most {most:.2f}); {self.reading}"
        if len(self.where) > 1:
            text += f"; {' or '.join(self.where[1:4])} would explain it as well"
        return text


def causes(fit: ModelFit, found: Sequence[FoundEffect]) -> tuple[Cause, ...]:
    """Of the functions among the single effects of a fit, the largest first."""
    made = [_cause(fit, f) for f in found if f.unnamed]
    return tuple(sorted(made, key=lambda c: -c.tip_m[0]))


def _cause(fit: ModelFit, found: FoundEffect) -> Cause:
    places = {t.key for t in found.terms}
    held = [(i, s) for i, s in enumerate(fit.slots) if s.owner.key in places]
    terms = tuple(s.owner for _, s in held if isinstance(s.owner, words.Found))
    amounts, shift = [], np.zeros(fit.residual.shape)
    for term, (i, slot) in zip(terms, held, strict=True):
        value = float(getattr(slot.owner, slot.parameter.name))
        error = float(fit.standard_errors[i])
        shift = shift + value * fit.columns[..., i]
        amounts.append((words.where(term), term.of.formula, value, error, slot.parameter.unit))
    size = np.linalg.norm(shift * fit.metres, axis=1)
    return Cause(
        terms,
        _places(terms, found),
        tuple((name, p) for name, p in found.names if name != found.name and p > 1 - CREDIBLE),
        words.formula(terms, [(v, e, u) for _, _, v, e, u in amounts]),
        words.reading(terms),
        tuple(words.domain(terms)),
        tuple(dict.fromkeys(s.of for t in terms for s in t.of.factors)),
        tuple(Coefficient(w, f, v, (v - 1.96 * e, v + 1.96 * e), u) for w, f, v, e, u in amounts),
        found.log_bayes_factor,
        found.there,
        (float(np.sqrt((size**2).mean())), float(size.max())),
        all(t.at != CAMERA for t in terms),
    )


def _places(terms: Sequence[words.Found], found: FoundEffect) -> tuple[str, ...]:
    """Where it may act: the place in the model, then others of the credible set."""
    first = " and ".join(dict.fromkeys(map(words.where, terms)))
    other = [" and ".join(places) for places in found.where]
    return (*dict.fromkeys((first, *words.seen_alike(terms), *other)),)
