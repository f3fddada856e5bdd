"""``longarm bench``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import as_text, note, print_json, print_rows, progress

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
    without a ratio. The benchmarks are not installed: this command needs a checkout of the
    project.

    \b
    Examples:
      longarm bench -o results
      longarm bench ik_single_vs_rtb_ik_lm_median --json
      longarm bench ros bags
    """
    _find_benchmarks()
    from bench import catalogue, machine
    from bench.plot import draw
    from longarm_comp.core.files import atomic_path, write_text

    chosen = catalogue.chosen(names)
    if listed:
        rows = [{"name": name, "kind": catalogue.KIND_OF[name]} for name in chosen]
        print_json(rows) if as_json else print_rows("Benchmarks", rows)
        return
    if output is not None:
        _writable(output)
    results: dict[str, Any] = {
        "machine": machine.machine(),
        "libraries": machine.libraries(),
        "load": [machine.load(), machine.load()],
        "results": [],
    }
    with progress("bench") as show:
        for done, name in enumerate(chosen):
            show(name, done / len(chosen))
            results["results"].append(_measured(name))
            results["load"][1] = machine.load()
            if output is not None:  # after every row: whoever stops early keeps what there is
                write_text(output / "results.json", as_text(results) + "\n")
    title = f"{results['machine']}; load {{:.1f}} to {{:.1f}}".format(*results["load"])
    if output is not None:
        with atomic_path(output / "results.png") as partial:
            draw(results["results"], title, partial)
        note(f"results.json and results.png in {output}")
    if as_json:
        print_json(results)
    else:
        shown = [{key: row.get(key) for key in _SHOWN} for row in results["results"]]
        print_rows(f"Benchmarks on {title}", shown)


def _find_benchmarks() -> None:
    """Make the folder ``bench`` of a checkout importable: beside the package, else here.

    Raises:
        JobError: neither place has it.
    """
    from longarm_comp.core.errors import JobError

    for root in (Path(__file__).resolve().parents[2], Path.cwd()):
        if (root / "bench" / "catalogue.py").is_file():
            if str(root) not in sys.path:
                sys.path.append(str(root))
            return
    raise JobError("bench is run from a checkout of the project")


def _measured(name: str) -> dict[str, Any]:
    """One row; what could not be measured says why, and the others go on."""
    from bench import catalogue, comparison
    from longarm_comp.core.errors import JobError

    try:
        return dict(catalogue.run(name))
    except JobError as error:
        return comparison.missing(name, "none", str(error))


def _writable(folder: Path) -> None:
    from longarm_comp.core.errors import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        said = error.strerror or str(error)
        raise InputError(folder, "--output", said, "a folder to write in") from error
