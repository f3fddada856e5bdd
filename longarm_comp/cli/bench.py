"""``longarm bench``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_rows, progress

_SHOWN = ("name", "value", "unit", "peer", "peer_value", "ratio", "spread")


@click.command()
@click.argument("names", nargs=-1, metavar="[NAMES]")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),  # type: ignore[type-var]
    help="Folder for results.json and results.png.",
)
@click.option("--list", "listed", is_flag=True, help="Only say which benchmarks there are.")
@options.as_json
def command(names: tuple[str, ...], output: Path | None, listed: bool, as_json: bool) -> None:
    """Measure this package beside its peers, all in one run; ratios above 1 mean faster.

    Without NAMES all are run, which takes about half an hour; kinematics, ssa, calibration, bags
    and so on (see --list) stand for all of their kind. Peers that are not installed give a row
    without a ratio.

    \b
    Examples:
      longarm bench -o results
      longarm bench ik_single_vs_rtb_ik_lm_median --json
      longarm bench ros bags
    """
    from longarm_comp.bench import catalogue, machine

    chosen = catalogue.chosen(names)
    if listed:
        rows = [{"name": name, "kind": catalogue.KIND_OF[name]} for name in chosen]
        print_json(rows) if as_json else print_rows("Benchmarks", rows)
        return
    if output is not None:
        _writable(output)
    made: list[dict[str, Any]] = []
    before = machine.load()
    with progress("bench") as show:
        for done, name in enumerate(chosen):
            show(name, done / len(chosen))
            made.append(dict(catalogue.run(name)))
    results = {
        "machine": machine.machine(),
        "libraries": machine.libraries(),
        "load": [before, machine.load()],
        "results": made,
    }
    title = f"{results['machine']}; load {before:.1f} to {machine.load():.1f}"
    if output is not None:
        _write(results, title, output)
        note(f"results.json and results.png in {output}")
    if as_json:
        print_json(results)
    else:
        print_rows(f"Benchmarks on {title}", [{k: row.get(k) for k in _SHOWN} for row in made])


def _writable(folder: Path) -> None:
    from longarm_comp.core.errors import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        said = error.strerror or str(error)
        raise InputError(folder, "--output", said, "a folder to write in") from error


def _write(results: dict[str, Any], title: str, folder: Path) -> None:
    from longarm_comp.bench.plot import draw
    from longarm_comp.cli.output import as_text
    from longarm_comp.core.files import atomic_path, write_text

    write_text(folder / "results.json", as_text(results) + "\n")
    with atomic_path(folder / "results.png") as partial:
        draw(results["results"], title, partial)
