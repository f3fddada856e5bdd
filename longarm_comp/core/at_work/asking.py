"""Which pose would tell two explanations apart that the moves of the work do not."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import LEGS, Context
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.at_work.explanations import Branch, Explanations
from longarm_comp.core.identify.posterior.found import CREDIBLE

POOL = 256
"""Poses that are looked at: a power of 2, as Sobol's points are even then; 25 ms."""


@dataclass(frozen=True, eq=False)
class Asked:
    q: np.ndarray  # (n,) commanded joints, rad and m
    side: np.ndarray  # (n,) of +-1, from which each joint arrives, by a run-up
    between: tuple[str, str]  # effects that it tells apart, the likelier first
    apart: float  # how far their predictions lie apart there, m

    @property
    def text(self) -> str:
        """In one line: ``backlash or servo_droop? measure q = 0.1 -0.3, from + -``."""
        q = " ".join(f"{value:.3f}" for value in self.q)
        side = " ".join("+" if value > 0 else "-" for value in self.side)
        return f"{' or '.join(self.between)}? measure q = {q}, from {side}"


def asked(known: Explanations, context: Context, noise: np.ndarray) -> Asked | None:
    """The pose where the likeliest explanation and a rival disagree most.

    None where there is no rival, or none that a single sighting would decide against.

    Args:
        known: all explanations.
        context: circumstances now.
        noise: (3, 3) m^2 of a sighting.
    """
    first, *others = known.branches
    rivals = [b for b in others if b.weight > 1.0 - CREDIBLE and _new(b, first)]
    if not rivals:
        return None
    space, arm = known.space, known.space.model.arm
    q, side = _pool(arm.lower, arm.upper)
    legs = np.zeros((*q.shape, LEGS))
    legs[..., 0] = side * run_up_lengths(arm)
    there = dataclasses.replace(
        context,
        approach=tuple(side.T),
        legs=tuple(legs.reshape(len(q), -1).T),
        columns={name: np.full(len(q), value) for name, value in context.columns.items()},
    )
    tips = [space.at(b.known.expected).tip(q, there) for b in (first, *rivals)]
    off = np.array(tips[1:]) - tips[0]
    odds = 0.5 * np.einsum("rij,jk,rik->ri", off, np.linalg.inv(noise), off)
    which, best = np.unravel_index(int(odds.argmax()), odds.shape)
    if odds[which, best] < np.log(CREDIBLE / (1.0 - CREDIBLE)):
        return None
    between = _new(first, rivals[which]) or "no change", _new(rivals[which], first)
    return Asked(q[best], side[best], between, float(np.linalg.norm(off[which, best])))


def _new(branch: Branch, other: Branch) -> str:
    """Name of an effect that has changed by one explanation and not by another, or ""."""
    theirs = {change.key for change in other.changes}
    return next((change.key[0] for change in branch.changes if change.key not in theirs), "")


def _pool(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints (N, n), even over their ranges, and sides (N, n) to arrive from."""
    from scipy.stats import qmc  # takes a quarter of a second

    unit = qmc.Sobol(2 * len(lower), seed=0).random(POOL)
    q, side = np.split(unit, 2, axis=1)
    return lower + (upper - lower) * q, np.where(side < 0.5, -1.0, 1.0)
