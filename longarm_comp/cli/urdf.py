"""``longarm export-urdf`` and ``import-urdf``."""

from __future__ import annotations

import math
from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, note_link_places, print_json, print_rows


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
        {"joint": joint, "offset": at, "unit": unit,
         "deg": math.degrees(at) if unit == "rad" else None}
        for joint, at, unit in made.zero_offsets(known)
    ]  # fmt: skip
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
    note(f"{arm.n} joints ({', '.join(arm.joint_names)}) in {output}")
    note_link_places(arm)
