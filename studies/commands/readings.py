"""``longarm study readings``."""

from __future__ import annotations

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows


@click.command()
@click.option(
    "--cases", type=click.IntRange(min=0), default=60, show_default=True, help="Planted cases."
)
@click.option(
    "--moves", type=click.IntRange(min=1), default=8, show_default=True, help="Trimmed moves."
)
@options.as_json
def command(cases: int, moves: int, as_json: bool) -> None:
    """What joint readings bring: names, the tip without a camera, trim.

    \b
    Example:
      longarm study readings --cases 6
    """
    import tempfile
    from pathlib import Path

    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies import readings

    config = folder("config")
    arm = Arm.load(config / "arm_demo.yaml")
    tip = readings.tip(arm)
    with tempfile.TemporaryDirectory() as scratch:
        trim = [readings.trimmed(config, Path(scratch), moves, on) for on in (False, True)]
    named = list(readings.names(arm, cases))
    right, servos, held = (sum(r[key] for r in named) for key in ("right", "servo", "held"))
    if as_json:
        print_json(
            {
                "tip": tip,
                "trim": trim,
                "names": named,
                "right": right,
                "servo": servos,
                "held": held,
            }
        )
        return
    print_rows("The tip of servos that droop and stick", [tip])
    print_rows("Servos that droop by 8 mm", trim)
    said = f"{right} of {cases} right and alone; the servos' in {servos}; true in a set in {held}"
    print_rows(f"Names: {said}", named)
