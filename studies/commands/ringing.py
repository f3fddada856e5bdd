"""``longarm study ringing``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from longarm_comp.cli import options
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(
    shape.arm,
    shape.arms(8, "Simulated arms, each made to sag by 20 mm."),
    shape.number("--moves", 10, "Moves of each arm."),
    options.seed,
)
def command(arm: Arm, arms: int, moves: int, seed: int, show: shape.Show) -> shape.Figures:
    """How long the tip rings after a move, unshaped and shaped, to 0.1 mm.

    The moves are shaped with the modes of the declared model, of a model calibrated at rest, and of
    the same model with the frequencies of one ring that was seen, also with these 10 % wrong.

    \b
    Example:
      longarm study ringing --arms 8
    """
    from studies import ringing

    rows = ringing.table(list(ringing.study(arm, arms, seed, moves, show)))
    title = f"Until the tip is within 0.1 mm, {arms} arms, {moves} moves each"
    return shape.Figures({"rows": rows}, {title: rows})
