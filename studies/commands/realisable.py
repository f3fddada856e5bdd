"""``longarm study realisable``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from longarm_comp.cli import options
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(
    shape.arm,
    shape.number("--targets", 60, "Targets per row."),
    shape.number(
        "--steps", 1000, "Servo steps per turn of a revolute joint; slides have 0.1 mm.", least=2
    ),
    options.seed,
)
def command(arm: Arm, targets: int, steps: int, seed: int, show: shape.Show) -> shape.Figures:
    """Compare the choice among the servos' steps with rounding, and its sensitivity.

    The truth is the declared model with sag. No measurement is used.

    \b
    Example:
      longarm study realisable --targets 60 --json
    """
    from studies import realisable

    tables = {
        "arms": ("Positions and poses (0.3 m/rad)", realisable.arms_table),
        "price": ("Price of movement; path: a line of 5 mm steps", realisable.price_table),
        "sensitivity": ("Servos or arm not as declared", realisable.sensitivity_table),
    }
    rows: dict[str, list[dict[str, object]]] = {}
    for k, (name, (title, table)) in enumerate(tables.items()):
        show(title, k / len(tables))
        rows[name] = table(arm, targets, steps, seed)
    return shape.Figures(
        {"targets": targets, "steps_per_turn": steps, "seed": seed, **rows},
        {title: rows[name] for name, (title, _) in tables.items()},
    )
