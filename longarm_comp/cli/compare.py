"""``longarm compare``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_table


@click.command()
@click.argument("a", type=click.Path(path_type=Path), metavar="A")
@click.argument("b", type=click.Path(path_type=Path), metavar="B")
@options.path_option("--arm", "Declared arm; needed to read sessions.")
@options.as_json
def command(a: Path, b: Path, arm: Path | None, as_json: bool) -> None:
    """Compare two diagnoses (folders), two models (model.yaml) or two sessions (CSV or bag).

    Prints the effects found in only one of them, values whose 95 % intervals do not overlap,
    held-out errors, and how far the tip moved at the poses that two sessions share.

    \b
    Examples:
      longarm compare diagnosis_may diagnosis_june
      longarm compare model.yaml model_new.yaml
      longarm compare monday.csv friday.csv --arm arm.yaml
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.workflows.compare import compare

    found = compare(a, b, None if arm is None else Arm.load(arm))
    if as_json:
        print_json(asdict(found))
        return
    for table in found.tables:
        if table.rows:
            print_table(table.title, table.header, table.rows)
    for sentence in found.said:
        click.echo(sentence)
