"""``longarm study other-arm``."""

from __future__ import annotations

from pathlib import Path

from longarm_comp.cli import options
from studies.commands import shape


@shape.study(options.path_option("--data", "Folder with dlr_justin.", required=True))
def command(data: Path, show: shape.Show) -> shape.Figures:
    """Calibrate DLR Justin's left arm with few rows and the compliance of its right arm.

    \b
    Example:
      longarm study other-arm --data real
    """
    from studies.other_arm import COUNTS, DRAWS, study

    steps, whole = iter(range(1000)), 1 + len(COUNTS) * DRAWS
    rows = list(study(data, COUNTS, DRAWS, lambda text: show(text, next(steps) / whole)))
    return shape.Figures({"left": rows}, {"Justin's left arm: mean error at its test poses": rows})
