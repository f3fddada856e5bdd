"""``longarm report compare``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.compare import show


@click.command()
@click.argument("a", type=click.Path(path_type=Path), metavar="A")
@click.argument("b", type=click.Path(path_type=Path), metavar="B")
@options.as_json
def command(a: Path, b: Path, as_json: bool) -> None:
    """Compare two diagnoses: A and B are folders that `longarm diagnose` wrote.

    \b
    Example:
      longarm report compare diagnosis_may diagnosis_june
    """
    from longarm_comp.report.record import read_report
    from longarm_comp.workflows.compare import of_diagnoses

    show(of_diagnoses(read_report(a), read_report(b)), as_json)
