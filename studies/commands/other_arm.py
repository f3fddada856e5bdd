"""``longarm study other-arm``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--data", "Folder with dlr_justin.", required=True)
@options.as_json
def command(data: Path, as_json: bool) -> None:
    """What the right arm of DLR Justin says of few rows of its left.

    \b
    Example:
      longarm study other-arm --data shared/data/real
    """
    from studies.other_arm import COUNTS, DRAWS, study

    with progress("study other-arm") as show:
        steps, whole = iter(range(1000)), 1 + len(COUNTS) * DRAWS
        rows = list(study(data, COUNTS, DRAWS, lambda text: show(text, next(steps) / whole)))
    if as_json:
        print_json({"left": rows})
        return
    print_rows("Justin's left arm: mean error at its test poses", rows)
