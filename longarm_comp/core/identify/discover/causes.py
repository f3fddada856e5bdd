"""Causes without a name: the discovered functions, described in words and numbers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.effects import discovered_words as words
from longarm_comp.core.effects.discovered_words import Found
from longarm_comp.core.effects.quantities import JointPosition, OfPosture
from longarm_comp.core.effects.shapes import Shape, Switch
from longarm_comp.core.identify.discover.inputs import FEW_LEVELS, count_levels
from longarm_comp.core.identify.posterior.found import CREDIBLE, FoundEffect
from longarm_comp.core.model.model import unstack
from longarm_comp.core.planning.optimal_poses import POOL


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
        terms: its terms as the model holds them.
        where: places that explain it equally well; the first is the one in the model.
        names: effects of the library that may be the cause instead, with their probability.
        formula: place, component and function with units.
        reading: its behaviour in words.
        domain: range of each quantity in the data, in words; beyond it the function keeps its value
            at the end.
        inputs: names of these quantities.
        amounts: the fitted coefficients.
        log_evidence: log Bayes factor beside the other effects.
        probability: probability that it, or an effect that cannot be told from it, exists.
        tip_m: rms and largest shift of the tip over the fitted rows, m.
        compensated: whether commands correct for it; never for a cause on the measuring side, nor
            for a circumstance that no command knows.
    """

    terms: tuple[Found, ...]
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
        """A sentence with the formula, its size at the tip, and its behaviour."""
        rms, most = (1e3 * v for v in self.tip_m)
        text = f"{self.formula} ({rms:.2f} mm rms at the tip, at most {most:.2f}); {self.reading}"
        if len(self.where) > 1:
            text += f"; {' or '.join(self.where[1:4])} would explain it as well"
        return text


def list_causes(fit: ModelFit, found: Sequence[FoundEffect]) -> tuple[Cause, ...]:
    """Describe each found effect without a name as a cause, the largest at the tip first."""
    made = [_describe_cause(fit, f) for f in found if f.unnamed]
    return tuple(sorted(made, key=lambda c: -c.tip_m[0]))


def _describe_cause(fit: ModelFit, found: FoundEffect) -> Cause:
    places = {t.key for t in found.terms}
    held = [(i, s) for i, s in enumerate(fit.slots) if s.owner.key in places]
    terms = tuple(s.owner for _, s in held if isinstance(s.owner, Found))
    amounts, figures, shift = [], [], np.zeros(fit.residual.shape)
    for term, (i, slot) in zip(terms, held, strict=True):
        value, error, unit = slot.value, float(fit.standard_errors[i]), slot.parameter.unit
        ci95 = value - 1.96 * error, value + 1.96 * error
        amounts.append(Coefficient(term.where, term.of.formula, value, ci95, unit))
        figures.append((value, error, unit))
        shift = shift + value * fit.columns[..., i]
    size = np.linalg.norm(shift * fit.metres, axis=1)
    likely = [r for r in found.rivals if r.probability > 1 - CREDIBLE]
    own, *alike = (
        " and ".join(dict.fromkeys(places)) for places in ([t.where for t in terms], *found.where)
    )
    return Cause(
        terms=terms,
        where=tuple(dict.fromkeys((own, *words.seen_alike(terms), *alike))),
        names=tuple((r.name, r.probability) for r in likely),
        formula=words.formula(terms, figures),
        reading=words.reading(terms),
        domain=tuple(words.domain(terms)),
        inputs=tuple(dict.fromkeys(shape.of for shape in _list_shapes(terms))),
        amounts=tuple(amounts),
        log_evidence=found.log_bayes_factor,
        probability=found.presence,
        tip_m=(float(np.sqrt((size**2).mean())), float(size.max())),
        compensated=all(t.commandable for t in terms),
    )


def describe_doubts(fit: ModelFit, found: Sequence[Found]) -> tuple[str, ...]:
    """Say in sentences what the data do not tell about functions.

    These are a joint that was measured at few positions, and a threshold in a gap of the data.
    """
    made = []
    for shape in _list_shapes(found):
        if _has_few_positions(fit, shape):
            made.append(f"{shape.of} was measured at few positions; between them it is a guess")
        if isinstance(shape, Switch):
            low, high = shape.threshold - shape.half, shape.threshold + shape.half
            made.append(f"it changes somewhere between {shape.of} {low:.4g} and {high:.4g}")
    return tuple(dict.fromkeys(made))


def propose_poses(fit: ModelFit, found: Sequence[Found], count: int, seed: int) -> np.ndarray:
    """Propose (M, n) poses, rad and m, that would settle the doubts: up to `count` for each."""
    arm, shapes = fit.model.arm, _list_shapes(found)
    if not shapes:
        return np.zeros((0, arm.n))
    from scipy.stats import qmc  # takes a quarter of a second

    pool = arm.lower + (arm.upper - arm.lower) * qmc.Sobol(arm.n, seed=seed).random(POOL)
    recorded = fit.session.context().columns
    usual = Context(columns={k: np.full(POOL, float(np.median(v))) for k, v in recorded.items()})
    posture = fit.model.posture(unstack(pool), usual)
    chosen: list[int] = []
    for shape in shapes:
        if isinstance(shape, Switch) and isinstance(shape.quantity, OfPosture):
            away = np.abs(np.asarray(shape.quantity.read(posture)) - shape.threshold)
            chosen += np.argsort(away + np.zeros(POOL), kind="stable")[:count].tolist()
        elif _has_few_positions(fit, shape):
            chosen += range(count)
    return np.asarray(pool[list(dict.fromkeys(chosen))])


def _list_shapes(found: Sequence[Found]) -> list[Shape]:
    return list(dict.fromkeys(s for t in found for s in t.of.factors))


def _has_few_positions(fit: ModelFit, shape: Shape) -> bool:
    of = shape.quantity
    if not isinstance(of, JointPosition):
        return False
    return count_levels(fit.session.q[:, of.joint]) <= FEW_LEVELS
