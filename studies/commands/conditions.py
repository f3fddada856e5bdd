"""``longarm study conditions``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from longarm_comp.cli import options
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(shape.arm, shape.arms(8, "Simulated arms."), options.seed)
def command(arm: Arm, arms: int, seed: int, show: shape.Show) -> shape.Figures:
    """Train in one condition, command in another: payload, temperature, wear.

    The paper's claim S14: error model and network together lose less than the network alone.
    About a minute an arm.

    \b
    Example:
      longarm study conditions --arms 8
    """
    from studies import conditions

    settings, found = conditions.rows_of(), []
    for number in range(arms):
        show(f"arm {number + 1} of {arms}", number / arms)
        found.append(conditions.one_arm(arm, seed, number, settings))
    rows, claims = conditions.table(found, settings), conditions.claims(found, settings)
    return shape.Figures(
        {"arms": arms, "rows": rows, "claims": claims},
        {
            f"Mean errors of the true tip, trained as in the first column: {arms} arms": rows,
            "S14: what another condition costs": [shape.with_ends(line) for line in claims],
        },
    )
