"""Causes without a name: the discovered functions, described in words and numbers.

A `Cause` is written to report.json, and the page and the command line print it.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field, GetPydanticSchema

from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.effects import discovered_words as words
from longarm_comp.core.effects.discovered_words import Found
from longarm_comp.core.effects.quantities import JointPosition, OfPosture
from longarm_comp.core.effects.shapes import Shape, Switch
from longarm_comp.core.identify.discover.inputs import FEW_LEVELS, count_levels
from longarm_comp.core.identify.findings import Pair, ReportPart
from longarm_comp.core.identify.posterior.found import CREDIBLE, FoundEffect
from longarm_comp.core.identify.proof import WITH_EFFECTS, WITH_FUNCTIONS
from longarm_comp.core.model.model import unstack
from longarm_comp.core.planning.optimal_poses import POOL


class Coefficient(ReportPart):
    """A coefficient of a cause without a name: value x function, at a place."""

    where: str
    function: str
    value: float
    ci95: Pair
    unit: str


class TipShift(ReportPart):
    """The shift of the tip by a cause, mm, over the fitted rows."""

    rms: float = Field(ge=0)
    max: float = Field(ge=0)


class Cause(ReportPart):
    """One cause without a name.

    Attributes:
        frame, component: the frames at which it acts, and how.
        where: places that explain it equally well; the first is the one in the model; ``set`` in
            report.json.
        names: effects of the library that may be the cause instead, with their probability.
        probability: probability that it, or an effect that cannot be told from it, exists.
        formula: place, component and function with units.
        amounts, ci95: the fitted coefficients, ``terms`` in report.json, and their intervals.
        domain: range of each quantity in the data, in words; beyond it the function keeps its value
            at the end.
        reading: its behaviour in words.
        title: the cause in words.
        action: one sentence for a mechanic.
        doubts: sentences on what the data do not tell about all causes without a name.
        log_evidence: log Bayes factor beside the other effects.
        tip_mm: its size at the tip.
        held_out_rms_mm: rms error at held-out rows without all such causes, and with them.
        compensated: whether commands correct for it; never for a cause on the measuring side, nor
            for a circumstance that no command knows.
        kept: whether the model to use holds it.
        effects: its terms as the model holds them; not in report.json.
    """

    frame: str
    component: str
    where: tuple[str, ...] = Field(alias="set")
    names: dict[str, float] = Field(default={})
    probability: float = Field(ge=0, le=1)
    formula: str
    amounts: tuple[Coefficient, ...] = Field(alias="terms")
    ci95: tuple[Pair, ...]
    domain: tuple[str, ...]
    reading: str
    title: str = ""
    action: str = ""
    doubts: tuple[str, ...] = ()
    log_evidence: float
    tip_mm: TipShift
    held_out_rms_mm: Pair
    compensated: bool
    kept: bool
    effects: Annotated[tuple[Found, ...], GetPydanticSchema(lambda _, handler: handler(Any))] = (
        Field(default=(), exclude=True, repr=False)
    )

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the quantities on which it depends."""
        return tuple(dict.fromkeys(shape.of for shape in _list_shapes(self.effects)))

    @property
    def sentence(self) -> str:
        """A sentence with the formula, its size at the tip, and its behaviour."""
        size = f"{self.tip_mm.rms:.2f} mm rms at the tip, at most {self.tip_mm.max:.2f}"
        text = f"{self.formula} ({size}); {self.reading}"
        if len(self.where) > 1:
            text += f"; {' or '.join(self.where[1:4])} would explain it as well"
        return text


def list_causes(
    fit: ModelFit, found: Sequence[FoundEffect], errors: Mapping[str, Errors], kept: bool
) -> tuple[Cause, ...]:
    """Describe each found effect without a name as a cause, the largest at the tip first.

    Args:
        fit: the final fit of all that was found.
        found: the found effects.
        errors: errors at held-out rows by model name (`Proof.rows`).
        kept: whether the model to use holds the functions.
    """
    made = [_describe_cause(fit, f, errors, kept) for f in found if f.unnamed]
    made.sort(key=lambda cause: -cause.tip_mm.rms)
    doubts = describe_doubts(fit, [t for cause in made for t in cause.effects])
    return tuple(cause.model_copy(update={"doubts": doubts}) for cause in made)


def _describe_cause(
    fit: ModelFit, found: FoundEffect, errors: Mapping[str, Errors], kept: bool
) -> Cause:
    places = {t.key for t in found.terms}
    held = [(i, s) for i, s in enumerate(fit.slots) if s.owner.key in places]
    terms = tuple(s.owner for _, s in held if isinstance(s.owner, Found))
    amounts, figures, shift = [], [], np.zeros(fit.residual.shape)
    for term, (i, slot) in zip(terms, held, strict=True):
        value, error, unit = slot.value, float(fit.standard_errors[i]), slot.parameter.unit
        ends, function = (value - 1.96 * error, value + 1.96 * error), term.of.formula
        amounts.append(
            Coefficient(where=term.where, function=function, value=value, ci95=ends, unit=unit)
        )
        figures.append((value, error, unit))
        shift = shift + value * fit.columns[..., i]
    tip_mm = 1e3 * np.linalg.norm(shift * fit.metres, axis=1)
    own, *alike = (
        " and ".join(dict.fromkeys(places)) for places in ([t.where for t in terms], *found.where)
    )
    at = [term.where.partition(", ") for term in terms]
    before, after = (1e3 * errors[name].rms for name in (WITH_EFFECTS, WITH_FUNCTIONS))
    made = Cause(
        frame=", ".join(dict.fromkeys(frame for frame, _, _ in at)),
        component=", ".join(dict.fromkeys(component for _, _, component in at)),
        set=tuple(dict.fromkeys((own, *words.seen_alike(terms), *alike))),
        names={r.name: r.probability for r in found.rivals if r.probability > 1 - CREDIBLE},
        probability=found.presence,
        formula=words.formula(terms, figures),
        terms=tuple(amounts),
        ci95=tuple(a.ci95 for a in amounts),
        domain=tuple(words.domain(terms)),
        reading=words.reading(terms),
        title=terms[0].heading(),
        action=terms[0].action,
        log_evidence=found.log_bayes_factor,
        tip_mm=TipShift(rms=float(np.sqrt((tip_mm**2).mean())), max=float(tip_mm.max())),
        held_out_rms_mm=(before, after),
        compensated=kept and all(t.commandable for t in terms),
        kept=kept,
    )
    return made.model_copy(update={"effects": terms})


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
