"""``longarm bench``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from bench import catalogue, comparison, machine
from bench.plot import draw
from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_rows, progress
from longarm_comp.core.errors import JobError
from longarm_comp.core.files import atomic_path, check_writable, write_text

_SHOWN = ("name", "value", "unit", "peer", "peer_value", "ratio", "spread")


@click.command()
@click.argument("names", nargs=-1, metavar="[NAMES]")
@options.written_option(
    "-o/--output",
    "Folder for results.json and results.png.",
    outputs.folder("results.json", "results.png", told_by="results.json"),
)
@click.option("--list", "listed", is_flag=True, help="Only list the benchmarks.")
@options.as_json
def command(names: tuple[str, ...], output: Path | None, listed: bool) -> None:
    """Measure the speed of this package and of other programs (peers) in one run.

    A ratio above 1 means that this package is faster than the peer. Without NAMES all benchmarks
    are run, which takes about half an hour. The name of a group such as kinematics, ssa or bags
    (see --list) runs the whole group. A peer that is not installed gives a line without a ratio.
    This command needs a checkout of the project, because the benchmarks are not installed with the
    package.

    \b
    Examples:
      longarm bench -o results
      longarm bench ik_single_vs_rtb_ik_lm_median --json
      longarm bench ros bags
    """
    chosen = catalogue.chosen(names)
    if listed:
        rows = [{"name": name, "kind": catalogue.KIND_OF[name]} for name in chosen]
        print_json(rows)
        print_rows("Benchmarks", rows)
        return
    if output is not None:
        check_writable(output)
    results: dict[str, Any] = {
        "machine": machine.machine(),
        "libraries": machine.libraries(),
        "load": [os.getloadavg()[0]] * 2,
        "results": [],
    }
    with progress("bench") as show:
        for done, name in enumerate(chosen):
            show(name, done / len(chosen))
            try:
                row = dict(catalogue.run(name))
            except JobError as error:  # the row holds the reason
                row = {"name": name, **comparison.missing("none", str(error))}
            results["results"].append(row)
            results["load"][1] = os.getloadavg()[0]
            if output is not None:  # after every row, so that an early stop keeps the results
                write_text(output / "results.json", outputs.json_text(results) + "\n")
    title = f"{results['machine']}; load {{:.1f}} to {{:.1f}}".format(*results["load"])
    if output is not None:
        with atomic_path(output / "results.png") as partial:
            draw(results["results"], title, partial)
        note(f"results.json and results.png in {output}")
    print_json(results)
    shown = [{key: row.get(key) for key in _SHOWN} for row in results["results"]]
    print_rows(f"Benchmarks on {title}", shown)
