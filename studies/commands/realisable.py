"""``longarm study realisable``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option(
    "--arm", "Declared arm whose variants are commanded; the demonstration's if absent."
)
@click.option(
    *("--targets", "count"), type=click.IntRange(min=1), default=60, show_default=True,
    help="Targets per row.",
)  # fmt: skip
@click.option(
    "--steps", type=click.IntRange(min=2), default=1000, show_default=True,
    help="Servo steps per turn of a revolute joint; slides have 0.1 mm.",
)  # fmt: skip
@options.seed
@options.as_json
def command(arm: Path | None, count: int, steps: int, seed: int, as_json: bool) -> None:
    """Compare the choice among the servos' steps with rounding, and its sensitivity.

    The truth is the declared model with sag. No measurement is used.

    \b
    Example:
      longarm study realisable --targets 60 --json
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.nodes.bringup import folder
    from studies import realisable

    base = Arm.load(arm or folder("config") / "arm_demo.yaml")
    tables = {
        "arms": ("Positions and poses (0.3 m/rad)", realisable.arms_table),
        "price": ("Price of movement; path: a line of 5 mm steps", realisable.price_table),
        "sensitivity": ("Servos or arm not as declared", realisable.sensitivity_table),
    }
    rows: dict[str, list[dict[str, object]]] = {}
    with progress("study realisable") as show:
        for k, (name, (title, table)) in enumerate(tables.items()):
            show(title, k / len(tables))
            rows[name] = table(base, count, steps, seed)
    if as_json:
        print_json({"targets": count, "steps_per_turn": steps, "seed": seed, **rows})
        return
    for name, (title, _) in tables.items():
        print_rows(title, rows[name])
