"""``longarm bench``."""

from __future__ import annotations

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows, progress

_SHOWN = ("name", "value", "unit", "peer", "peer_value", "ratio", "spread")


@click.command()
@click.argument("names", nargs=-1, metavar="[NAMES]")
@options.as_json
def command(names: tuple[str, ...], as_json: bool) -> None:
    """Measure this package beside its peers, all in one run; ratios above 1 mean faster.

    Without NAMES all are run; kinematics, ssa and ros stand for all of their kind. Peers that
    are not installed give a row without a ratio.

    \b
    Examples:
      longarm bench
      longarm bench ik_single_vs_rtb_ik_lm_median --json
      longarm bench ros
    """
    from longarm_comp.bench import catalogue

    chosen = catalogue.chosen(names)
    rows = []
    with progress("bench") as show:
        for done, name in enumerate(chosen):
            show(name, done / len(chosen))
            rows.append(catalogue.run(name))
    if as_json:
        print_json({"machine": catalogue.machine(), "results": rows})
        return
    shown = [{key: row.get(key) for key in _SHOWN} for row in rows]
    print_rows(f"Benchmarks on {catalogue.machine()}", shown)
