"""``longarm import-data``, ``import-urdf`` and ``export-urdf``: files of other programs."""

from __future__ import annotations

import math
from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_rows
from longarm_comp.cli.signals import by_name


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
    "--map",
    "pairs",
    multiple=True,
    metavar="A=q1,...",
    help="Meaning of columns, also with a unit: A=q3:mm. Repeat for more.",
)
@click.option("--rotation", metavar="CONVENTION:COLUMNS", help="Orientation; see below.")
@options.path_option("--arm", "arm.yaml: names the joints and says which slide.")
@options.path_option("--like", "Mapping of an earlier file of the same kind, instead of the above.")
@click.option("--sheet", help="Sheet of a workbook that has several.")
@click.option("--join", metavar="COLUMN", help="Column that shows which rows belong together.")
@click.option("--sort", metavar="COLUMN", help="Column that shows the order of measurement.")
@click.option("--columns", default="", metavar="q1,...,x,y,z", help="Names where no line has them.")
@options.choice("--decimal", [".", ","], "Sign before decimals.")
@options.as_json
def command(
    files: tuple[Path, ...],
    output: Path,
    units: str,
    columns: str,
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
    printed, as are poses (tx..qw, Px..R22). Units are never guessed, nor conventions that the names
    of an orientation leave open. --rotation takes xyzw or wxyz with four columns, matrix with nine,
    rotvec with three, or Euler angles with three: xyz about fixed axes, ZYX about turned axes. A
    minus before it says that the columns hold the base in the tool. "none" leaves the orientation
    out.

    \b
    Examples:
      longarm import-data tracker.csv --units mm,deg -o samples.csv
      longarm import-data log.xlsx --units mm,deg --map "A=q1,B=q2:mm,Px=x" --rotation ZYX:A,B,C
      longarm import-data second.csv --like samples.mapping.yaml -o second_samples.csv
      longarm import-data mocap.csv --units m,rad --rotation wxyz:q0,q1,q2,q3 --arm arm.yaml
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.sessions.foreign.convert import Options, import_table

    of_columns, names = (
        tuple(word.strip() for word in text.split(",") if word.strip()) for text in (units, columns)
    )
    declared = None if arm is None else Arm.load(arm)
    each = [pair for text in pairs for pair in text.split(",")]
    given = by_name("import-data", "--map", each, "COLUMN=NAME")
    said = Options(of_columns, given, arm=declared, sort=sort, columns=names, **told)
    found = import_table(files, said if like is None else said.like(like))
    mapping = found.save(output)
    rows = found.preview()
    count = len(found.cells.rows)
    facts = {"output": output, "mapping": mapping, "rows": count, "columns": rows}
    print_json({**facts, "left_out": found.left_out})
    print_rows(f"{', '.join(f.name for f in files)}: {count} rows, as read (SI)", rows)
    if found.rotation is not None:
        note(f"orientation from {', '.join(found.rotation.columns)} as {found.rotation.convention}")
    for said_of in found.joined:
        note(said_of)
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


@click.command("export-urdf")
@options.arm
@options.path_option("--model", "Calibrated model.yaml.", required=True)
@options.output("calibrated.urdf", "URDF to write.", outputs.URDF)
@click.option("--group", default="", help="Base placement, if the model has several.")
@click.option(
    "--marker", default="", help="Use this marker as the link tip, instead of the arm's tip."
)
@options.effects
@options.as_json
def export_urdf(arm: options.Arm, model: Path, output: Path, group: str, marker: str) -> None:
    """Write the rigid part of MODEL as a URDF with calibrated joint origins.

    The link base_link is the frame of the measurements, the link tip is the tip. The origins
    contain the offsets of the joints' zeros; they are also listed, for a driver that corrects them
    itself. Deflection and the other effects stay in model.yaml, because a URDF cannot hold them.

    \b
    Example:
      longarm export-urdf arm.yaml --model model.yaml -o calibrated.urdf
    """
    from longarm_comp import urdf_export as made
    from longarm_comp.core.files import write_text
    from longarm_comp.core.model.model_file import load_model

    known = load_model(model, arm)
    write_text(output, made.export_urdf(known, group, marker))
    left = sorted({e.name for e in known.effects if not e.geometry})
    rows = [
        {
            "joint": joint,
            "offset": at,
            "unit": unit,
            "deg": math.degrees(at) if unit == "rad" else None,
        }
        for joint, at, unit in made.zero_offsets(known)
    ]
    print_json({"output": output, "zero_offsets": rows, "left_out": left})
    print_rows("Joint values at command zero (in the origins already)", rows)
    if left:
        note(f"left out, because a URDF is rigid: {', '.join(left)}")
    note(f"{arm.n} joints in {output}")


@click.command("import-urdf")
@options.path_argument("urdf", "URDF")
@click.option("--base", required=True, metavar="LINK", help="Fixed link.")
@click.option("--tip", required=True, metavar="LINK", help="Link that is commanded and measured.")
@options.output("arm.yaml", "Arm to write.", outputs.never)
def import_urdf(urdf: Path, base: str, tip: str, output: Path) -> None:
    """Write an arm.yaml for the chain of URDF from --base to --tip.

    Limits, masses, centres of mass and mimic joints are taken over. Lengths lie along a and d of
    the DH rows; add the bending beams (links) there by hand (docs/arm.md).

    \b
    Example:
      longarm import-urdf panda.urdf --base panda_link0 --tip panda_link8 -o arm.yaml
    """
    from longarm_comp import urdf as read
    from longarm_comp.arm_folder.make import arm_file
    from longarm_comp.core.files import write_text

    data = read.import_urdf(urdf, base, tip)
    text, arm = arm_file(data, f"From {urdf.name}, {base} to {tip}.", {}, seen=False)
    write_text(output, text)
    for joint in read.read_drives(urdf, data).values():
        if joint.hard != joint.limits:
            note(f"joint {joint.name}: taken are {read.describe_drive(joint)}")
    note(f"{arm.n} joints ({', '.join(arm.joint_names)}) in {output}")
