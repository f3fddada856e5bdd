"""``longarm demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import as_text, note, print_json, print_rows, progress
from longarm_comp.core.errors import JobError

SHOWN = ("model", "n", "mean_mm", "rms_mm", "max_mm", "mean_abs_z_mm", "true_mean_mm",
         "paper_mean_mm")  # fmt: skip


@click.command()
@options.path_option("--out", "New folder for session, model, predictor and report.", True)
@options.path_option("--arm", "Another arm: arm.yaml or its folder; default: the demonstration's.")
@click.option("--poses", type=int, default=120, help="Poses to learn from.")
@click.option("--targets", type=int, default=40, help="New targets.")
@click.option("--hidden", help="Undeclared effects of the arm: 'name=mm name=mm'.")
@click.option("--speed", type=float, default=20.0, help="Speed-up of all motion.")
@click.option("--seed", type=click.IntRange(min=0), default=1)
@options.as_json
def command(out: Path, arm: Path | None, targets: int, **given: Any) -> None:
    """Run the whole loop over the real ROS graph on a simulated arm.

    Five nodes start. The simulated arm has errors that nobody declared. It drives to fresh targets,
    first without compensation, then with the declared deflection. A session is collected into a
    bag. The diagnosis looks for the missing effects, and a network is trained on the remaining
    error. The arm drives to the same targets again with the effects found, and also with the
    network if that lowers the error at poses left out of its training. The cameras measure the
    table. The exit code is 3 if nothing improved.

    \b
    Examples:
      longarm demo --out build/demo
      longarm demo --out build/mine --arm my_arm
    """
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.core.files import write_text
    from longarm_comp.jobs.demo import DemoSettings, demonstrate

    if arm is not None:
        given["arm"] = arm / "arm.yaml" if arm.is_dir() else arm
    said = {name: value for name, value in given.items() if value is not None}
    settings = DemoSettings(out, targets=targets, **said)
    with stop_on_signals() as stop, progress("demo", lines=True) as show:
        printed = demonstrate(settings, stop, show)
    write_text(out / "demo.json", as_text(printed))
    print_json(printed)
    columns = [{name: row[name] for name in SHOWN} for row in printed["rows"]]
    print_rows(f"{targets} fresh targets, 3-D errors; the paper's arm beside", columns)
    seconds = printed["seconds"]["total"]
    note(f"measured by the cameras; true_mean_mm is the simulation's own; {seconds:.0f} s")
    note(f"hidden in the arm: {settings.hidden} (mm rms at the tip)")
    note(f"diagnosis ({printed['verdict']}): {printed['diagnosis']}")
    if printed["network_refused"]:
        note(f"no network is used: {printed['network_refused']}")
    if printed["network_inputs"]:
        used = targets - printed["outside_training_data"]
        note(f"the network was used at {used} of {targets} targets; at the others physics alone")
        note("is as good, or the targets are outside its training data")
    note(f"report in {printed['files']['report']}, the loop's page in {printed['files']['loop']}")
    if not printed["improved"]:
        raise JobError("compensation did not bring the arm nearer to its targets")
