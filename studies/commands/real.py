"""``longarm study real``."""

from __future__ import annotations

from pathlib import Path

from longarm_comp.cli import options
from studies.commands import shape

_STEPS = 24  # fits in all, roughly: for the bar only


@shape.study(
    options.path_option("--data", "Folder with dlr_justin, wam_ur5 or both.", required=True)
)
def command(data: Path, show: shape.Show) -> shape.Figures:
    """Held-out errors on real arms: DLR Agile Justin, Barrett WAM, UR5.

    "diagnosed" is the model that a diagnosis of the training rows writes. "frames_only" fits only
    the placement of base and tool, which is often a large part of a published "before".

    \b
    Example:
      longarm study real --data test/data --json
    """
    from studies.real import study

    steps = iter(range(_STEPS))
    robots = study(data, lambda text: show(text, min(next(steps, _STEPS), _STEPS) / _STEPS))
    record, tables, notes = {}, {}, []
    for robot, lines in robots.items():
        errors = [
            {
                "model": line.model,
                "mean_mm": 1e3 * line.errors.mean,
                "rms_mm": 1e3 * line.errors.rms,
                "max_mm": 1e3 * line.errors.max,
                "n": line.errors.n,
            }
            for line in lines
        ]
        ends = [[1e3 * end for end in line.ci95] for line in lines]
        record[robot] = [
            row | {"ci95_mm": ci95, "effects": list(line.effects)}
            for row, ci95, line in zip(errors, ends, lines, strict=True)
        ]
        tables[f"{robot}: errors on the test rows"] = errors
        said = lines[-1].commanded
        assert said is not None  # the last line is the diagnosed model
        before, after, *gain = (1e3 * v for v in (said.calibrated, said.written, *said.gain_ci95))
        record[robot][-1] |= {
            "commanded_mm": after,
            "calibrated_commanded_mm": before,
            "commanded_gain_ci95_mm": gain,
        }
        held = ", ".join(lines[-1].effects) or "nothing beyond geometry"
        notes += [
            f"{robot}: 95 % of the diagnosed mean {ends[-1][0]:.3f} to {ends[-1][1]:.3f} mm",
            f"{robot}: as commanded {before:.3f} mm calibrated, {after:.3f} diagnosed "
            f"(95 % of the gain {gain[0]:.3f} to {gain[1]:.3f})",
            f"{robot}: diagnosed as {held}",
        ]
    return shape.Figures(record, tables, notes)
