"""``longarm study readings``."""

from __future__ import annotations

import tempfile
from pathlib import Path

from studies.commands import shape


@shape.study(
    shape.number("--cases", 60, "Planted cases.", least=0),
    shape.number("--moves", 8, "Trimmed moves."),
)
def command(cases: int, moves: int, show: shape.Show) -> shape.Figures:
    """What joint readings improve: names of effects, the tip without a camera, trim.

    \b
    Example:
      longarm study readings --cases 6
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies import readings

    config = folder("config")
    arm = Arm.load(config / "arm_demo.yaml")
    tip = readings.tip(arm)
    with tempfile.TemporaryDirectory() as scratch:
        trim = [readings.trimmed(config, Path(scratch), moves, on) for on in (False, True)]
    named, soft = list(readings.names(arm, cases)), list(readings.softness(arm))
    right, servos, held = (sum(r[key] for r in named) for key in ("right", "servo", "held"))
    said = f"{right} of {cases} right and alone; the servos' in {servos}; true in a set in {held}"
    return shape.Figures(
        {
            "tip": tip,
            "trim": trim,
            "names": named,
            "right": right,
            "servo": servos,
            "held": held,
            "softness": soft,
        },
        {
            "The tip of servos that droop and stick": [tip],
            "Servos that droop by 8 mm": trim,
            f"Names: {said}": named,
            "How sure the name of a soft joint can be": soft,
        },
    )
