"""``longarm study touch``."""

from __future__ import annotations

from pathlib import Path

from longarm_comp.cli import options
from studies.commands import shape

_STEPS = 25  # places of the six arms: for the bar only


@shape.study(
    options.path_option("--data", "Folder with a CSV an arm: location, socket, q1..q7.", True)
)
def command(data: Path, show: shape.Show) -> shape.Figures:
    """Errors of calibration and diagnosis at sockets held out in turn, on real arms.

    nominal: the data sheet, with the place of the ball; rigid: its geometry calibrated;
    diagnosed: with what a diagnosis of the same rows added.

    \b
    Example:
      longarm study touch --data touch_pandas --json
    """
    from studies.touch import lines, study

    steps = iter(range(_STEPS))
    found = lines(study(data, lambda text: show(text, next(steps, _STEPS) / _STEPS)))
    *arms, together = found
    shown = [{k: v for k, v in row.items() if k != "names" and "ci95" not in k} for row in found]
    gain = f"{together['gain_mm']} {together['gain_ci95_mm']} mm"
    means = (f"{k} {together[f'{k}_ci95_mm']}" for k in ("nominal", "rigid", "diagnosed"))
    names = (", ".join(row["names"]) or "nothing named" for row in arms)  # type: ignore[arg-type]
    return shape.Figures(
        {"arms": arms, "all": together},
        {"Mean distance from the touched point, each place held out in turn": shown},
        [
            f"diagnosed leaves less than rigid, over places: {gain}",
            "95 % of the means, over places, mm: " + ", ".join(means),
            *(f"{row['arm']}: {said}" for row, said in zip(arms, names, strict=True)),
        ],
    )
