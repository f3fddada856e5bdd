"""``longarm demo``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_rows, progress


@click.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="New folder for the session, the model, the predictor and the report.",
)
@click.option("--poses", type=int, default=130, show_default=True, help="Poses to learn from.")
@click.option("--targets", type=int, default=40, show_default=True, help="Fresh targets.")
@click.option("--hidden", help="Undeclared effects of the arm: 'name=mm name=mm'.")
@click.option("--speed", type=float, default=20.0, show_default=True, help="Times real motion.")
@click.option("--no-diagnosis", is_flag=True, help="Calibrate and train only.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@options.as_json
def command(
    out: Path,
    poses: int,
    targets: int,
    hidden: str | None,
    speed: float,
    no_diagnosis: bool,
    seed: int,
    as_json: bool,
) -> None:
    """The whole loop over the real ROS graph on a simulated arm.

    Five nodes start; the arm has errors that nobody declared. Fresh targets are driven, a
    session is collected into a bag, the model is calibrated and the network trained on it, and
    the same targets are driven again through the compensate service. Ends with the
    before/after table, measured by the stereo cameras; exit code 3 where it did not improve.

    \b
    Example:
      longarm demo --out build/demo
    """
    import json
    from dataclasses import replace

    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.core.errors import JobError
    from longarm_comp.core.files import write_text
    from longarm_comp.jobs.demo.loop import demonstrate, report
    from longarm_comp.jobs.demo.setting import Setting

    setting = Setting(out, poses, targets, speed=speed, seed=seed)
    if no_diagnosis:
        setting = replace(setting, diagnosis_s=0.0)
    if hidden is not None:
        setting = replace(setting, hidden=hidden)
    with stop_on_signals() as stop, progress("demo") as show:
        outcome = demonstrate(setting, stop, show)
    made = report(setting, outcome)
    write_text(out / "demo.json", json.dumps(made, indent=2))
    if as_json:
        print_json(made)
    else:
        print_rows(f"{targets} fresh targets, 3-D errors; the paper's arm beside", made["rows"])
        seconds = made["seconds"]["total"]
        note(f"the arm hides {setting.hidden}; diagnosis: {made['diagnosis']}")
        note(f"measured by the cameras; true_mean_mm is the simulation's own; {seconds:.0f} s")
    if not outcome.improved:
        raise JobError("compensation did not bring the arm nearer to its targets")
