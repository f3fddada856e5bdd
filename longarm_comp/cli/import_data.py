"""``longarm import-data``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_rows
from longarm_comp.core.errors import InputError


@click.command()
@options.path_argument("files", "FILE...", nargs=-1, required=True)
@options.output(
    "samples.csv",
    "Session to write; the mapping is written beside it.",
    outputs.session,
    lambda path: [path.with_suffix(".mapping.yaml")],
)
@click.option(
    "--units", default="", metavar="mm,deg", help="Units of columns whose names have none."
)
@click.option(
    "--map", "pairs", multiple=True, metavar="A=q1,...",
    help="Meaning of columns, also with a unit: A=q3:mm. Repeat for more.",
)  # fmt: skip
@click.option("--rotation", metavar="CONVENTION:COLUMNS", help="Orientation; see below.")
@options.path_option("--arm", "arm.yaml: names the joints and says which slide.")
@options.path_option("--like", "Mapping of an earlier file of the same kind, instead of the above.")
@click.option("--sheet", help="Sheet of a workbook that has several.")
@click.option("--join", metavar="COLUMN", help="Column that shows which rows belong together.")
@click.option("--sort", metavar="COLUMN", help="Column that shows the order of measurement.")
@options.choice("--decimal", [".", ","], "Sign before decimals.")
@options.as_json
def command(
    files: tuple[Path, ...],
    output: Path,
    units: str,
    pairs: tuple[str, ...],
    arm: Path | None,
    like: Path | None,
    sort: str | None,
    **told: str | None,
) -> None:
    """Convert FILE (CSV, TXT or XLSX) of another program to a session.

    Several FILEs are put one after the other, as days follow each other. With --join they are put
    side by side, for instance joints from one FILE and the tracker's points from another. Markers
    side by side (M1 x, M1 y, ...) become rows.

    Separators, header lines, decimal commas and units in names (x_mm, q1 [deg]) are recognised and
    printed. Units and the convention of an orientation are never guessed. --rotation takes xyzw or
    wxyz with four columns, rotvec with three, or Euler angles with three: xyz about fixed axes, ZYX
    about turned axes. A minus before it says that the columns hold the base in the tool. "none"
    leaves the orientation out.

    \b
    Examples:
      longarm import-data tracker.csv --units mm,deg -o samples.csv
      longarm import-data log.xlsx --units mm,deg --map "A=q1,B=q2:mm,Px=x" --rotation ZYX:A,B,C
      longarm import-data second.csv --like samples.mapping.yaml -o second_samples.csv
      longarm import-data mocap.csv --units m,rad --rotation wxyz:q0,qi,qj,qk --arm arm.yaml
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.sessions.foreign.convert import Options, import_table

    of_columns = tuple(u.strip() for u in units.split(",") if u.strip())
    declared = None if arm is None else Arm.load(arm)
    said = Options(of_columns, _pairs(pairs), arm=declared, sort=sort, **told)
    found = import_table(files, said if like is None else said.like(like))
    mapping = found.save(output)
    rows = found.preview()
    count = len(found.cells.rows)
    facts = {"output": output, "mapping": mapping, "rows": count, "columns": rows}
    print_json({**facts, "left_out": found.left_out})
    print_rows(f"{', '.join(f.name for f in files)}: {count} rows, as read (SI)", rows)
    if found.rotation is not None:
        note(f"orientation from {', '.join(found.rotation.columns)} as {found.rotation.convention}")
    for alone in found.lonely:
        note(alone)
    if found.markers:
        note(f"markers side by side, a row each: {', '.join(found.markers)}")
    if sort is None and not {"t_s", "index"} & set(found.columns):
        said_not = "in the file's order, which determines the sides of arrival"
        note(f"rows are taken {said_not}; --sort COLUMN says another")
    if found.left_out:
        note(f"left out: {', '.join(found.left_out)}")
    if found.assumed:
        note(f"{', '.join(found.assumed)}: taken to turn; --arm says which joints slide")
    note(f"{output} written, mapping in {mapping}")


def _pairs(given: tuple[str, ...]) -> dict[str, str]:
    made: dict[str, str] = {}
    for pair in (p for text in given for p in text.split(",")):
        source, equals, name = pair.partition("=")
        if not equals or not source.strip() or not name.strip() or source.strip() in made:
            raise InputError("import-data", "--map", pair, "COLUMN=NAME, each column once")
        made[source.strip()] = name.strip()
    return made
