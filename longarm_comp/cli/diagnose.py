"""``longarm diagnose``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_effects, print_json, print_rows, progress, say


@click.command()
@options.arm
@options.session
@options.path_option("--test", "Hold-out (CSV or bag); default: blocks of SESSION.")
@options.path_option("--model", "Known model; its effects are not added again.")
@options.kind_of
@options.seed
@options.without("network", "Train no network on the remaining error.")
@options.output("diagnosis", "Folder to write.", outputs.DIAGNOSIS, outputs.diagnosed)
@options.effects
@options.as_json
def command(arm: options.Arm, session: Path, output: Path, **how: Any) -> None:
    """Find in SESSION (CSV or bag) the effects that ARM's model lacks, add them and prove them.

    Writes report.json, report.html, plots, and model.yaml with the effects found (longarm undo
    restores the version of --model). Also writes predictor.npz if a network lowered the error at
    rows left out of its training, and next_poses.csv if more poses would tell two effects apart.

    \b
    Examples:
      longarm diagnose arm.yaml samples.csv --test test.csv -o diagnosis
      longarm diagnose arm.yaml bag --model model.yaml -o diagnosis
      longarm diagnose arm.yaml samples.csv -o diagnosis --kind-of others/*.yaml
    """
    from longarm_comp.report.cards import said, to_do
    from longarm_comp.report.record import checked
    from longarm_comp.workflows.diagnose import diagnose_files

    with progress("diagnose") as show:
        found = diagnose_files(arm, session, output, progress=show, **how)
    report = found.report()
    print_json({"output": str(output), **report})
    rows = report["held_out"]["rows"]
    absent = {name for name in rows[0] if all(row[name] is None for row in rows)}
    shown = [{k: v for k, v in row.items() if k not in absent} for row in rows]
    print_rows(f"Held-out errors ({report['held_out']['n']} rows)", shown)
    keys = ("where", "name", "value", "ci95", "unit")
    added = [(f["effect"], *map(p.get, keys)) for f in report["findings"] for p in f["parameters"]]
    print_effects("Effects added", report["called"], added)
    for duty, held in to_do(checked(report).for_people()).items():
        for card in held:
            size = "; ".join(filter(None, (card.tip, card.sure, f"{card.figure} {card.improves}")))
            say(f"{duty.lower()}: {card.title} ({size}): {said(card)} {card.software}")
    say(f"{report['verdict']}: {report['summary']}")
    note(f"report in {output / 'report.html'}, model in {output / 'model.yaml'}")
