"""``longarm day-report``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_rows


@click.command()
@options.arm
@options.bag
@options.output("day.html", "Page to write.", outputs.marked(b"<!doctype html>", b"A day of work"))
@options.namespace_of(None, "Namespace of the arm, if the bag holds several.")
@options.as_json
def command(arm: options.Arm, bag: Path, output: Path, namespace: str | None) -> None:
    """Make a page of a recorded day: errors by the hour, what was learned, what was refused.

    `longarm record` makes the bag while the arm works.

    \b
    Example:
      longarm day-report my_arm bag_today -o today.html
    """
    from longarm_comp.core.at_work import LEARNED_SAID
    from longarm_comp.core.files import write_text
    from longarm_comp.report.pages import day_page
    from longarm_comp.sessions.day import read_day

    day = read_day(bag, arm, namespace, (LEARNED_SAID,))
    write_text(output, day_page(arm.name, bag.name, day))
    rows, said = day.by_hour(), [vars(s) for s in day.said]
    print_json({"page": output, "rows": rows, "refused": day.refused, "said": said})
    print_rows(f"{arm.name}: {day.hours:.1f} h", rows)
    note(f"page in {output}")
