"""Commands in circumstances that no row of the session had: how much the expected error grows.

A session at one payload determines only the product of a load and the compliance under it. The
effect of a heavier load follows from the physics alone, so `sigma` grows outside the session's
range.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import INCLINATION, Context, is_told
from longarm_comp.core.effects.catalogue import searched_effects
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.units import describe_range
from longarm_comp.core.ik.columns import tip_and_columns
from longarm_comp.core.ik.engines import posture_at, tip_poses
from longarm_comp.core.model.model import Model, Slot, slots_of
from longarm_comp.core.model.uncertainty import YIELDS

KNOWN_TO = 0.2
"""Share by which a predicted change may be wrong: declared masses, and compliances under them, are
right to a fifth."""
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Beyond:
    """One circumstance of M commands, outside the session's range at some of them.

    Attributes:
        name: of the circumstance.
        change: (M, 3) m, standard deviation of the error in the change of the tip that the model
            predicts, with the signs of this change: the error is the same share of it everywhere.
        rest: (M, 3) m^2, variance of what else the circumstance may move.
        text: M texts that name the value and the range, "" within it.
    """

    name: str
    change: np.ndarray
    rest: np.ndarray
    text: list[str]


def beyond_session(model: Model, q: np.ndarray, context: Context) -> tuple[np.ndarray, list[str]]:
    """Estimate how far off the tip may be, because no row was measured in these circumstances.

    Args:
        q: (M, n) commanded joints, rad and m.
        context: circumstances of all, or of each.

    Returns:
        Standard deviations (M, 3) in m, and M texts that name the circumstances. Zeros and "" in
        the ranges of the session, or if the model does not hold these ranges.
    """
    variance, said = np.zeros((len(q), 3)), [""] * len(q)
    for each in list_beyond(model, q, context):
        variance += each.change**2 + each.rest
        said = ["; ".join(filter(None, two)) for two in zip(said, each.text, strict=True)]
    return np.sqrt(variance), said


def list_beyond(model: Model, q: np.ndarray, context: Context) -> list[Beyond]:
    """List the circumstances that are outside the session's ranges; arguments as above."""
    made = []
    known = dict({} if model.uncertainty is None else model.uncertainty.circumstances)
    tilts = [name for name in context.columns if INCLINATION.match(name)]
    if known and tilts:  # a tilt that was not recorded, or is not known now, counts as level
        tilts = [f"{name[:-1]}{axis}" for name in tilts for axis in "xy"]
        known = dict.fromkeys(tilts, (0.0, 0.0)) | known
        level = {name: known[name][0] for name in tilts}
        context = dataclasses.replace(context, columns={**level, **context.columns})
    for name, (low, high) in known.items():
        if name not in context.columns:
            continue
        values = np.broadcast_to(np.asarray(context.columns[name], float), len(q))
        rounding = _ROUNDING * max(abs(low), abs(high), 1.0)
        beyond = (values < low - rounding) | (values > high + rounding)
        if not beyond.any():
            continue
        columns = {**context.columns, name: np.clip(values, low, high)}
        edge = dataclasses.replace(context, columns=columns)
        one_load = name == "payload_kg" and high - low <= rounding
        change, rest = (
            np.where(beyond[:, None], part, 0.0)
            for part in _doubt_of_change(model, q, context, edge, one_load)
        )
        mm = 1e3 * np.linalg.norm(np.sqrt(change**2 + rest), axis=1)
        text = [
            f"{name} {value:.4g} is beyond the session's {describe_range(low, high)}"
            f" (sigma {size:.2f} mm)"
            if there
            else ""
            for value, size, there in zip(values, mm, beyond, strict=True)
        ]
        made.append(Beyond(name, change, rest, text))
    return made


def outside_data(model: Model, q: np.ndarray, context: Context) -> tuple[np.ndarray, list[str]]:
    """Estimate how far off the tip may be, because functions without a name are extrapolated.

    Outside its data a function keeps its value at their end, and its true value is not known.

    Args:
        q: (M, n) commanded joints, rad and m.
        context: circumstances of all, or of each.

    Returns:
        Standard deviations (M, 3) in m, and M sentences that name the quantities outside the data;
        zeros and "" if there are none.
    """
    found = [effect for effect in model.effects if isinstance(effect, Discovered)]
    if not found:
        return np.zeros((len(q), 3)), [""] * len(q)
    posture = posture_at(model, q, context)
    named = zip(*(effect.outside(posture) for effect in found), strict=True)
    parts = [sorted({part for each in row for part in each}) for row in named]
    if not any(parts):
        return np.zeros((len(q), 3)), [""] * len(q)
    units = [dataclasses.replace(effect, function="1", domain="") for effect in found]
    columns = model.columns(posture, slots_of(model.arm, units))[1].reshape(-1, 3, len(units))
    more = [np.broadcast_to(effect.change_beyond(posture), len(q)) for effect in found]
    sd = np.linalg.norm(columns * np.stack(more, axis=-1)[:, None], axis=-1)
    text = "outside the data from which an effect was found"
    said = [f"{text}: {', '.join(row)}" if row else "" for row in parts]
    return sd, said


def _doubt_of_change(
    model: Model, q: np.ndarray, context: Context, edge: Context, one_load: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate how far off the predicted change of the tip may be: `Beyond.change` and `rest`.

    The change is that from the edge of the session's range to the present circumstances. The model
    predicts it to a share of `KNOWN_TO`. This share is larger if causes without a name depend on
    the changed circumstance: if they move the tip half as far as the named effects, it is about a
    half.  Effects that no row could show add their prior size.

    Args:
        one_load: whether the payload changed and was the same in all rows. Then the rows do not
            tell which causes without a name depend on it, so all of them count.
    """
    nameless = [e for e in model.effects if isinstance(e, Discovered)]
    felt = set()
    if nameless:
        there, here = (posture_at(model, q, c) for c in (context, edge))
    for effect in nameless:
        pairs = [(quantity.read(there), quantity.read(here)) for quantity in effect.of.quantities]
        mine, other = effect.twists(there), effect.twists(here)
        pairs += [pair for k in mine for pair in zip(mine[k], other[k], strict=True)]
        alike = all(np.allclose(a, b, rtol=_ROUNDING, atol=0.0) for a, b in pairs)
        if one_load or not alike:
            felt.add(effect.key)
    whole = tip_poses(model, q, edge)[:, :3, 3]
    moved = tip_poses(model, q, context)[:, :3, 3] - whole
    ratio = np.zeros(len(q))
    if felt:
        named, bare = (
            dataclasses.replace(model, effects=tuple(effects)).tip(q, edge)
            for effects in (
                [e for e in model.effects if e.key not in felt],
                [e for e in model.effects if e.geometry],
            )
        )
        ratio = np.linalg.norm(whole - named, axis=1)
        ratio /= np.maximum(np.linalg.norm(named - bare, axis=1), 1e-12)
    share = np.hypot(KNOWN_TO, np.minimum(ratio, 1.0))

    def moves(slots: Sequence[Slot], sizes: np.ndarray) -> np.ndarray:
        """Compute the variance (M, 3), m^2, of the change by parameters of these sizes."""
        there, here = (tip_and_columns(model, q, c, slots)[1] for c in (context, edge))
        columns = there - here
        return np.asarray(((columns * sizes) ** 2).sum(axis=-1))

    every, slots, sizes = _list_absent(model, context)
    rest = moves(slots, sizes) if slots else np.zeros((len(q), 3))
    for absent in every:
        if not absent.parameters(model.arm):  # it follows from the reading alone, as tilt does
            there_with, here_with = (model.plus(absent).tip(q, c) for c in (context, edge))
            rest += (there_with - here_with - moved) ** 2
    if one_load and nameless:
        # A cause without a name at one load may stand for any elastic effect
        elastic = slots_of(model.arm, [t for t in _list_searched_effects(model) if t.elastic])
        sizes = np.array([YIELDS * s.parameter.width for s in elastic])
        rest += np.minimum(ratio, 1.0)[:, None] ** 2 * moves(elastic, sizes)
    return share[:, None] * moved, rest


def _list_searched_effects(model: Model) -> list[Effect]:
    """List every effect that is searched for, at each of its places in the arm."""
    kinds = (kind for kind in searched_effects() if issubclass(kind, Effect))
    return [term for kind in kinds for term in kind.for_arm(model.arm)]


def _list_absent_effects(model: Model, context: Context) -> list[Effect]:
    """List the effects that the model lacks and no row could show.

    They are all effects that read a known circumstance. If the model holds no elastic effect, all
    elastic effects are added, because a calibration puts the sag of its rows into its geometry.
    """
    held = {effect.key for effect in model.effects}
    if model.uncertainty is not None:  # these have their uncertainty there
        held |= {effect.key for effect in model.uncertainty.absent}
    stiff = not any(effect.elastic for effect in model.effects)
    return [
        t
        for t in _list_searched_effects(model)
        if t.key not in held and not t.missing(context)
        if (stiff and t.elastic) or any(is_told(name) for name in (*t.needs, *t.inputs))
    ]


def absent_slots(model: Model, context: Context) -> tuple[tuple[Slot, ...], np.ndarray]:
    """List the k parameters of effects that the model lacks and no row could show.

    Returns:
        The parameters, and the size (k,) that each may have: one prior standard deviation, times
        `YIELDS` for an elastic effect.
    """
    return _list_absent(model, context)[1:]


def _list_absent(
    model: Model, context: Context
) -> tuple[list[Effect], tuple[Slot, ...], np.ndarray]:
    """Return the effects of `_list_absent_effects`, then `absent_slots`; kept with the model."""
    name = f"absent {sorted((*context.columns, *context.labels))}"
    if name not in model.memo:
        effects = _list_absent_effects(model, context)
        slots = slots_of(model.arm, effects)
        sizes = [s.parameter.width * (YIELDS if s.owner.elastic else 1.0) for s in slots]
        model.memo[name] = effects, slots, np.array(sizes)
    held: tuple[list[Effect], tuple[Slot, ...], np.ndarray] = model.memo[name]
    return held
