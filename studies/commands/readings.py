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
    from longarm_comp.core.identify.posterior.found import CREDIBLE
    from longarm_comp.share import folder
    from studies import readings

    config = folder("config")
    arm = Arm.load(config / "arm_demo.yaml")
    tip = readings.tip(arm)
    with tempfile.TemporaryDirectory() as scratch:
        trim = [readings.trimmed(config, Path(scratch), moves, on) for on in (False, True)]
    named, soft = list(readings.names(arm, cases)), list(readings.softness(arm))
    sure = {row["joint"]: row["name"] >= CREDIBLE for row in reversed(soft)}  # the first stays
    apart = [r["planted"] == "servo_droop" or sure[r["joint"]] for r in named]
    counts = [
        {
            "rows": f"tell them apart: {said}",
            "n": sum(one is told for one in apart),
            **{
                key: sum(r["is"] == key for r, one in zip(named, apart, strict=True) if one is told)
                for key in readings.SAID
            },
        }
        for said, told in (("yes", True), ("no", False))
    ]
    servos = sum(r["servo"] for r in named)
    return shape.Figures(
        {
            "tip": tip,
            "trim": trim,
            "names": named,
            "counts": counts,
            "servo": servos,
            "softness": soft,
        },
        {
            "The tip of servos that droop and stick": [tip],
            "Servos that droop by 8 mm": trim,
            "How sure the name of a soft joint can be": soft,
            "Names": named,
            f"Names, all together; the servos' are right in {servos} of {cases}": counts,
        },
    )
