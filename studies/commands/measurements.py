"""``longarm study measurements``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from longarm_comp.cli import options
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(shape.arm, shape.arms(5), options.seed)
def command(arm: Arm, arms: int, seed: int, show: shape.Show) -> shape.Figures:
    """How many rows a calibration needs if a row is a pose, a position, one distance, or a touch.

    Errors are of the true tip at poses that were not measured.

    \b
    Example:
      longarm study measurements --arms 5
    """
    from studies import measurements

    counts, found = measurements.ROWS, []
    for k in range(arms):
        found.append(measurements.errors_by_rows(arm, seed + k, counts))
        show(f"{k + 1} of {arms} arms", (k + 1) / arms)
    rows = measurements.table(found, counts)
    needed = measurements.needed(found, counts, (1e-3, 5e-4, 2.5e-4))
    return shape.Figures(
        {"arms": arms, "seed": seed, "errors": rows, "needed": needed},
        {f"Error of the true tip, median of {arms} arms": rows, "Rows needed": needed},
    )
