"""Effects of a joint that the rows could not show: what they may add to the error of a command.

A joint that never moved in the session, or arrived from one side only, may have a wrong gain, play
or friction.  The rows cannot distinguish them from an error of its zero.  A command that moves the
joint, or arrives from the other side, feels them.  Of a joint that moved, the rows show such
effects as far as these are larger than what the model leaves unexplained.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import LEGS, PER_JOINT, Context
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import searched_effects
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.units import describe_range
from longarm_comp.core.model.domain import RowDomain, least_moved
from longarm_comp.core.model.model import Model, Slot, slots_of, unstack
from longarm_comp.core.model.uncertainty import ModelUncertainty

_FAR = 1e6  # rad, m: farther than any play
_LEAST = 0.05
"""Smallest standard deviation that is worth a word, as a share of the largest expected error at the
fitted rows."""
_SIDES = ("above", "below")
_LARGE = 2.0
"""Size of an effect that bounds the growth of the structure, in standard deviations of its prior.

With 1, rows of half of a joint's range promise too little if its gear runs four of them out of
round: 20 % of the commands in the other half are inside, with 2 more than 65 %.
"""


@dataclass(frozen=True, eq=False)
class _Unshown:
    """The effects of one joint that the model does not hold, and what the rows say of them.

    Attributes:
        slots: parameters of the model, then those of the effects.
        whole: (p, 1 + p) the values of all that are most probable, given the rows, and the factor
            of their covariance.
        alone: the same of the parameters of the model, if the arm has none of the effects.
        text: the effects in words.
    """

    slots: tuple[Slot, ...]
    whole: np.ndarray
    alone: np.ndarray
    text: str


def unshown_effects(model: Model, q: np.ndarray, context: Context) -> tuple[np.ndarray, list[str]]:
    """Estimate how far off the tip may be by effects that no row could show.

    They are those of joints that hardly moved in the rows and stand elsewhere, and of joints that
    arrived from one side in every row and may arrive from the other.  Those of a joint that moved
    are in `structure_left`.

    Args:
        q: (M, n) commanded joints, rad and m.
        context: circumstances of all, or of each.

    Returns:
        The covariance (M, 3, 3), m^2, that these effects add, and M texts; zeros and "" for
        commands at which every joint is as in the rows.
    """
    known, arm = model.uncertainty, model.arm
    covariance, said = np.zeros((len(q), 3, 3)), [list[str]() for _ in q]
    if known is None or known.domain is None:
        return covariance, [""] * len(q)
    sides, shares, least = _sides(context, q), _shares_of_sides(model), least_moved(arm)
    for j, name in enumerate(arm.joint_names):
        low, high = known.circumstances.get(f"q{j + 1}", (-np.inf, np.inf))
        moved = bool(high - low > least[j])
        away = np.maximum(low - q[:, j], q[:, j] - high) > arm.telling[j]
        away &= not moved
        only = int(shares[j].argmax())
        other = np.full(len(q), shares[j, only] == 1.0 and high - low > arm.telling[j])
        other &= sides[:, j] != (-1.0, 1.0)[only]
        here = np.flatnonzero(away | other)
        if not len(here):
            continue
        effects = _judge_joint(model, known, known.domain, j, moved)
        if not effects.text:  # the model holds them all
            continue
        added = _compute_covariance(model, q[here], context.take(here), effects)
        covariance[here] += added
        sizes = np.sqrt(np.maximum(np.einsum("kii->k", added), 0.0))
        for k, size in zip(here.tolist(), sizes, strict=True):
            if size < _LEAST * known.largest_m:
                continue
            how = f"{name} arrived from {_SIDES[only]} in every row and may not here"
            if away[k]:
                how = f"{name} {q[k, j]:.4g} is beyond the session's {describe_range(low, high)}"
            said[k].append(f"{how}: its {effects.text} did not show (sigma {1e3 * size:.2f} mm)")
    return covariance, ["; ".join(each) for each in said]


def structure_left(
    model: Model, known: ModelUncertainty, q: np.ndarray, context: Context
) -> np.ndarray:
    """Return the covariance (M, 3, 3), m^2, of what no parameter explains at joints (M, n).

    It grows away from the rows as `ModelUncertainty.structure_at` says.  This growth has a bound,
    because the smoothest error that hides in the structure of few poses may be larger than any
    machine's: that by effects of the joints that moved, twice as large as usual.

    Args:
        known: the uncertainty of the model, or that of the model before it.
        context: circumstances of all, or of each.
    """
    least = least_moved(model.arm)
    grown = known.structure_at(q, least) - known.structure
    size = np.einsum("kii->k", grown)
    far = np.flatnonzero(size > np.trace(known.structure))
    if known.domain is not None and len(far):
        effects = _judge_moved(model, known, known.domain)
        bound = _carry_to_tip(model, q[far], context.take(far), effects)
        most = np.maximum(np.einsum("kii->k", bound), np.trace(known.structure))
        grown[far] *= np.minimum(1.0, most / size[far])[:, None, None]
    return np.asarray(known.structure + grown)


def describe_unshown(arm: Arm, rows: Session) -> str:
    """Say of which joints the rows cannot show play, gain or friction; "" if there are none."""
    span, sides = np.ptp(rows.q, axis=0), np.array(rows.arrivals or np.ones((arm.n, 2)))
    still = span <= least_moved(arm)
    one_sided = ~still & (sides.min(axis=1) == 0) & (sides.max(axis=1) > 0)
    names = np.array(arm.joint_names)
    told = [
        f"{', '.join(names[which])} {what}"
        for which, what in ((still, "hardly moved"), (one_sided, "arrived from one side only"))
        if which.any()
    ]
    if not told:
        return ""
    return (
        f"{' and '.join(told)}: commands that differ state a wider radius, as play, gain or "
        "friction there did not show."
    )


def _sides(context: Context, q: np.ndarray) -> np.ndarray:
    """Return the sides from which the joints arrive at commands (M, n); 0: unknown."""
    given = context.of_all("approach", q.shape[1])
    each = [np.broadcast_to(np.asarray(side, float), len(q)) for side in given]
    return np.stack(each, axis=-1)


def _shares_of_sides(model: Model) -> np.ndarray:
    """Return the shares (n, 2) of the rows in which each joint arrived from above and from below.

    Where no side is known, both are as frequent: what depends on the side is then in the scatter.
    """
    known = np.array(model.arrivals or np.zeros((model.arm.n, 2)), float)
    count = known.sum(axis=1, keepdims=True)
    return np.where(count > 0.0, known / np.maximum(count, 1.0), 0.5)


def _judge_joint(
    model: Model, known: ModelUncertainty, domain: RowDomain, joint: int, moved: bool
) -> _Unshown:
    """Compute what the rows say of the effects of a joint, from the places where they stood.

    Args:
        moved: whether the joint moved by more than `LEAST_MOVED`.
    """
    name = f"unshown {joint}"
    if name not in model.memo:
        places, effects = domain.q.copy(), _list_effects(model, known, model.arm.commanded[joint])
        if moved:  # the rows show all but what depends on the side
            effects = [effect for effect in effects if effect.inputs]
        else:  # such rows do not tell how an error varies with it
            places[:, joint] = places[:, joint].mean()
        left = known.noise + known.structure
        model.memo[name] = _judge_effects(model, known, places, effects, left)
    held: _Unshown = model.memo[name]
    return held


def _judge_moved(model: Model, known: ModelUncertainty, domain: RowDomain) -> _Unshown:
    """Compute what the rows say of the effects of all joints that moved, but for sides.

    What the model leaves unexplained is similar in similar rows, so all rows count as one.
    """
    name = "unshown of moved"
    if name not in model.memo:
        rows = [model.arm.commanded[j] for j in np.flatnonzero(np.isfinite(domain.span))]
        every = {e.key: e for row in rows for e in _list_effects(model, known, row) if not e.inputs}
        effects, left = list(every.values()), known.noise + len(domain.q) * known.structure
        model.memo[name] = _judge_effects(model, known, domain.q, effects, left, _LARGE)
    held: _Unshown = model.memo[name]
    return held


def _judge_effects(
    model: Model,
    known: ModelUncertainty,
    places: np.ndarray,
    effects: Sequence[Effect],
    left: np.ndarray,
    size: float = 1.0,
) -> _Unshown:
    """Compute what rows at some places say of effects.

    The rows' own circumstances are not known any more, so the middle of their ranges stands for
    them, and the end of the session for their times.

    Args:
        places: (R, n) joints, rad and m.
        left: (3, 3) m^2, covariance of what each row leaves.
        size: of the effects, in standard deviations of their prior.
    """
    arm = model.arm
    fitted, absent = model.uncertain_slots(known), slots_of(arm, effects)
    # The forms of an effect exclude each other: they share its variance
    forms = np.array([sum(e.key == s.owner.key for e in effects) for s in absent])
    width = np.array([s.parameter.width for s in (*fitted, *absent)])
    width[len(fitted) :] *= size / np.sqrt(forms)
    shares = _shares_of_sides(model)
    drawn = np.random.default_rng(0).random(places.shape) < shares[:, 1]
    unmoved = (np.ptp(places, axis=0) <= arm.telling) & (shares[:, 0] == 0.5)
    amid = {name: 0.5 * (low + high) for name, (low, high) in known.circumstances.items()}
    there = Context(columns=amid).as_left(model.ended_s)
    came = _arriving(there, np.where(drawn | unmoved, 1.0, -1.0))
    noise = math.sqrt(max(float(np.trace(left)) / 3.0, 1e-12))
    columns = _columns(model, places, came, (*fitted, *absent))
    white = columns.reshape(-1, len(width)) * width / noise
    seen = white[:, : len(fitted)] @ (np.array([s.value for s in fitted]) / width[: len(fitted)])
    factors = []
    for part in (white, white[:, : len(fitted)]):
        values, vectors = np.linalg.eigh(part.T @ part)
        factor = vectors / np.sqrt(1.0 + np.maximum(values, 0.0))
        likely = factor @ (factor.T @ (part.T @ seen))
        factors.append(np.column_stack([likely, factor]) * width[: len(likely), None])
    text = ", ".join(dict.fromkeys(effect.heading() for effect in effects))
    whole, alone = factors
    return _Unshown((*fitted, *absent), whole, alone, text)


def _list_effects(model: Model, known: ModelUncertainty, row: int) -> list[Effect]:
    """List the effects of a row's joint that the model does not hold and a command may feel."""
    held = {effect.key for effect in (*model.effects, *known.absent)}
    kinds = [k for k in searched_effects() if issubclass(k, Effect) and not k.aliases]
    every = [effect for kind in kinds for effect in kind.for_arm(model.arm)]
    return [
        effect
        for effect in every
        if row in effect.joints and effect.key not in held and effect.parameters(model.arm)
        if all(name in PER_JOINT for name in effect.inputs)
    ]


def _compute_covariance(
    model: Model, q: np.ndarray, context: Context, effects: _Unshown
) -> np.ndarray:
    """Compute the covariance (M, 3, 3), m^2, that a joint's effects add at commands (M, n).

    If it is not known from which side a joint arrives, it is the mean over both.
    """
    sides, covariance = _sides(context, q), np.zeros((len(q), 3, 3))
    for side in (-1.0, 1.0):
        there = _arriving(context, np.where(sides == 0.0, side, sides))
        covariance += 0.5 * _carry_to_tip(model, q, there, effects)
    return covariance


def _carry_to_tip(model: Model, q: np.ndarray, context: Context, effects: _Unshown) -> np.ndarray:
    """Compute the covariance (M, 3, 3), m^2, that effects add at commands (M, n)."""
    columns = _columns(model, q, context, effects.slots)
    whole = columns @ effects.whole
    alone = columns[..., : len(effects.alone)] @ effects.alone
    whole[..., 0] -= alone[..., 0]
    alone[..., 0] = 0.0
    return np.asarray(whole @ np.swapaxes(whole, 1, 2) - alone @ np.swapaxes(alone, 1, 2))


def _arriving(context: Context, sides: np.ndarray) -> Context:
    """Return circumstances in which the joints arrived over a long way from sides (M, n)."""
    legs = np.zeros((*sides.shape, LEGS))
    legs[..., 0] = _FAR * sides
    history: dict[str, Any] = {
        "approach": tuple(sides.T),
        "legs": tuple(legs.reshape(len(sides), -1).T),
        "last_way": tuple(0.0 * sides.T),
    }
    return replace(context, **history)


def _columns(model: Model, q: np.ndarray, context: Context, slots: Sequence[Slot]) -> np.ndarray:
    """Return the derivatives (M, 3, k) of the tip at joints (M, n)."""
    return model.columns(model.posture(unstack(q), context), slots)[1].reshape(-1, 3, len(slots))
