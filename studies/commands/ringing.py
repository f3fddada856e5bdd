"""``longarm study ringing``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--arm", "Declared arm; the demonstration's if absent.")
@click.option(
    *("--arms", "count"), type=click.IntRange(min=1), default=8, show_default=True,
    help="Simulated arms, each made to sag by 20 mm.",
)  # fmt: skip
@click.option(
    "--moves", type=click.IntRange(min=1), default=10, show_default=True, help="Moves of each arm."
)
@options.seed
@options.as_json
def command(arm: Path | None, count: int, moves: int, seed: int, as_json: bool) -> None:
    """How long the tip rings after a move, unshaped and shaped, to 0.1 mm.

    The moves are shaped by the modes of the declared model, of one that was identified at rest,
    and of the same with the frequencies of one ring that was seen; and with these 10 % wrong.

    \b
    Example:
      longarm study ringing --arms 8
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies import ringing

    declared = Arm.load(arm or folder("config") / "arm_demo.yaml")
    with progress("study ringing") as show:
        rows = ringing.table(list(ringing.study(declared, count, seed, moves, show)))
    if as_json:
        print_json({"rows": rows})
        return
    print_rows(f"Until the tip is within 0.1 mm, {count} arms, {moves} moves each", rows)
