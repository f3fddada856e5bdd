"""``longarm calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_effects, print_json, print_rows, progress


@click.command()
@options.arm
@options.session
@options.output("model.yaml", "Calibrated model to write.", outputs.MODEL)
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="NAME",
    help="Also fit this effect, at every joint or beam that may have it; repeat for more.",
)
@options.without("deflection", "Treat the declared beams as stiff.")
@click.option("--fraction", type=float, default=0.2, help="Share of rows held out.")
@options.kind_of
@options.seed
@options.effects
@options.as_json
def command(arm: options.Arm, session: Path, output: Path, **how: Any) -> None:
    """Fit geometry and declared effects of ARM to SESSION (CSV or bag).

    Models that know more and more are fitted without the held-out rows and compared at them. The
    last model is then fitted to all rows and written with 95 % intervals.

    \b
    Examples:
      longarm calibrate arm.yaml samples.csv -o model.yaml
      longarm calibrate arm.yaml samples.csv --effect joint_compliance --effect bearing_tilt
      longarm calibrate arm.yaml samples.csv --kind-of others/*.yaml
    """
    from longarm_comp.workflows.calibrate import calibrate

    with progress("calibrate") as show:
        calibration = calibrate(arm, session, note=note, progress=show, **how)
    calibration.save(output)
    if calibration.placed:
        note("the declared arm was first placed by the rows, because they see it at another place")
    for place in calibration.untold:
        note(f"the rows do not show {place}: left as declared")
    for name in calibration.not_helping:
        note(f"{name} did not lower the held-out error: better leave it out")
    rows, final = calibration.held_out.rows, calibration.fit
    print_json(
        {
            "output": str(output),
            "held_out": rows,
            "parameters": [vars(p) for p in calibration.parameters],
            "sigma_mm": 1e3 * final.sigma,
            "outliers": final.session.index[final.outliers],
            "converged": final.converged,
            "session_hash": calibration.session.hash,
            "placed": calibration.placed,
            "untold": calibration.untold,
        }
    )
    print_rows(
        f"Held-out errors ({calibration.held_out_rows} of {len(calibration.session)} rows)", rows
    )
    added = [p for p in calibration.parameters if not p.geometry]
    found = [(p.effect, p.where, p.name, p.value, p.ci95, p.unit) for p in added]
    print_effects("Effects, fitted to all rows", arm.called, found)
    # The user's own number of each row, else its index
    called_rows = final.session.labels.get("point", final.session.index)
    left = ", ".join(map(str, called_rows[final.outliers]))
    which = f": {left}" if left else ""
    note(f"{len(final.outliers)} rows left out as outliers{which}; model in {output}")
    if not final.converged:
        note(
            "the fit did not converge: its last step was above a hundredth of the errors after "
            f"{final.iterations}"
        )
