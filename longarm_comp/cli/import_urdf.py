"""``longarm import-urdf``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, note_link_places


@click.command()
@options.path_argument("urdf", "URDF")
@click.option("--base", required=True, metavar="LINK", help="Fixed link.")
@click.option("--tip", required=True, metavar="LINK", help="Link that is commanded and measured.")
@options.output("arm.yaml", "Arm to write.", outputs.never)
def command(urdf: Path, base: str, tip: str, output: Path) -> None:
    """Write an arm.yaml for the chain of URDF from --base to --tip.

    Limits, masses, centres of mass and mimic joints are taken over. Lengths lie along a and d of
    the DH rows; add the bending beams (links) there by hand (docs/arm.md).

    \b
    Example:
      longarm import-urdf panda.urdf --base panda_link0 --tip panda_link8 -o arm.yaml
    """
    import yaml

    from longarm_comp import urdf as read
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.files import write_text

    data = read.import_urdf(urdf, base, tip)
    arm = Arm.parse(data, str(urdf))
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
    write_text(output, f"# From {urdf.name}, {base} to {tip}; add `links` where it bends.\n{text}")
    note(f"{arm.n} joints ({', '.join(arm.joint_names)}) in {output}")
    note_link_places(arm)
