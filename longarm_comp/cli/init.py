"""``longarm init`` and ``longarm check``: an arm's folder."""

from pathlib import Path

import click
from click.core import ParameterSource

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, say
from longarm_comp.cli.signals import numbers_by_name
from longarm_comp.core.errors import InputError, JobError

_TAKEN_WITH = {
    **dict.fromkeys(("base", "tip"), ("--urdf",)),
    **dict.fromkeys(("tip_at", "payload"), ("--joint",)),
    **dict.fromkeys(("name", "range_deg", "home"), ("--urdf", "--joint")),
    **dict.fromkeys(("servos", "hobby", "only_arm"), ("--urdf", "--arm", "--joint")),
}
"""By parameter: the sources of an arm with which it means something."""


@click.command()
@options.path_argument("out", "DIR")
@options.path_option("--urdf", "From a URDF.")
@click.option("--base", default="", metavar="LINK", help="URDF: fixed link; default: its root.")
@click.option("--tip", default="", metavar="LINK", help="URDF: link that is commanded.")
@options.choice("--like", ["demo"], "A copy of the demonstration's files.")
@options.path_option("--arm", "An existing arm.yaml; the other files are made for it.")
@click.option("--name", default="", help="Name of the arm.")
@click.option(
    "--joint",
    "rows",
    multiple=True,
    metavar="ROW",
    help="A row of the DH table, base to tip: 'type=revolute alpha=90 a=0.1 d=0 limits=-30..30'.",
)
@click.option(
    "--tip-at",
    nargs=3,
    type=float,
    default=(0.0, 0.0, 0.0),
    metavar="X Y Z",
    help="Tip in the last frame, m.",
)
@click.option("--payload", type=float, default=0.0, help="Carried mass, kg.")
@click.option(
    "--range",
    "range_deg",
    type=click.FloatRange(0.0, 720.0),
    default=None,
    help="Largest range of a turning joint, deg; 0: as it is. Default: 45 for a URDF, else 0.",
)
@click.option("--home", multiple=True, metavar="JOINT=DEG", help="Middle of that range.")
@click.option("--servos", default="sts3215", help="Model of the servos.")
@options.flag(
    "--hobby",
    "For a printed arm and two webcams: servo horns as joints, cameras near, marker on A4.",
)
@options.flag(
    "--only-arm",
    "Write arm.yaml alone, with all limits of the URDF, for another controller and sensor.",
)
@options.as_json
def command(
    out: Path,
    urdf: Path | None,
    base: str,
    tip: str,
    like: str | None,
    arm: Path | None,
    name: str,
    rows: tuple[str, ...],
    tip_at: tuple[float, float, float],
    payload: float,
    range_deg: float | None,
    home: tuple[str, ...],
    servos: str,
    hobby: bool,
    only_arm: bool,
) -> None:
    """Write a new folder DIR: arm.yaml, and servo, camera and marker files that fit it.

    The arm comes from a URDF, the demonstration, an arm.yaml or a DH table. `longarm up
    DIR/arm.yaml --sim` simulates the new arm. `longarm check DIR` lists assumed values that you
    must measure.

    \b
    Examples:
      longarm init my_arm --like demo
      longarm init my_arm --urdf robot.urdf --base base_link --tip tool0
      longarm init boom --urdf boom.urdf --only-arm
      longarm init my_arm --urdf so101.urdf --hobby
      longarm init my_arm --joint 'alpha=0 d=0.1 limits=-60..60' \\
        --joint 'alpha=90 limits=0..70 a=0 material=petg' --joint 'a=0.3 tube_a=30/26' \\
        --tip-at 0.2 0 0
    """
    from longarm_comp.arm_folder import make
    from longarm_comp.arm_folder.dh_table import arm_of
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.devices.servo_bus.registry import models
    from longarm_comp.sim.servo_emulator.wires import list_wires
    from longarm_comp.urdf import chain_ends, describe_drive, import_urdf, read_drives

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("init", "DIR", out, "a new or empty folder")
    sources = {"--urdf": urdf, "--like": like, "--arm": arm, "--joint": rows}
    given = [option for option, value in sources.items() if value]
    if len(given) != 1:
        allowed = "one of --urdf FILE, --like demo, --arm FILE, --joint ROW --joint ROW ..."
        raise InputError("init", "source", " and ".join(given) or "none", allowed)
    context = click.get_current_context()
    for option in context.command.params:
        takes = _TAKEN_WITH.get(option.name or "", given)
        told = context.get_parameter_source(option.name or "") is ParameterSource.COMMANDLINE
        if told and given[0] not in takes:
            value, allowed = context.params[option.name or ""], f"with {' or '.join(takes)} alone"
            raise InputError("init", option.opts[0], value, allowed)
    drives = {}
    if like is not None:
        files = make.demonstration()
    else:
        if arm is not None:
            made, text = Arm.load(arm), arm.read_text("utf-8")
        else:
            if urdf is not None:
                base, tip = chain_ends(urdf, base, tip)
                data, where = import_urdf(urdf, base, tip), f"{urdf.name}, {base} to {tip}"
                data["name"] = name or data["name"]
                drives = read_drives(urdf, data)
            else:
                data, where = arm_of(name or out.name, rows, tip_at, payload), "a DH table"
            homes = numbers_by_name("init", "--home", home, "JOINT=DEG, for instance joint2=30")
            if range_deg is None and hobby:
                range_deg = make.find_range_in_sight(data, homes)
            elif range_deg is None:
                # Range of a turning joint that is driven through all of it in a first session
                range_deg = 45.0 if urdf is not None and not only_arm else 0.0
            data, notes = make.narrow_limits(data, range_deg, homes)
            head = f"The declared arm, from {where}. `longarm check` lists what is still assumed."
            head += _RANGES.format(range_deg) if notes else ""
            for row, joint in drives.items():
                notes[row] = "; ".join(filter(None, (notes.get(row), describe_drive(joint))))
                if joint.hard != joint.limits:
                    note(f"joint {joint.name}: {describe_drive(joint)}")
            text, made = make.arm_file(data, head, notes, seen=not only_arm)
        files = {make.ARM: text}
        if not only_arm:
            fastest = {row: joint.velocity for row, joint in drives.items()}
            others = make.parameter_files(made, servos, hobby, fastest)
            files |= {f"{node}.yaml": text for node, text in others.items()}
    make.write_folder(out, files)
    print_json({"folder": out, "files": list(files)})
    note(f"{', '.join(files)} in {out}")
    then = f"longarm up {out}/arm.yaml --sim"
    if only_arm:
        then = f"longarm import-data FILE --arm {out}/arm.yaml -o {out}/samples.csv"
    elif like is None and models()[servos].protocol not in list_wires():
        then = f"longarm up {out}/arm.yaml"
    note(f"next: longarm check {out}; {then}")


_RANGES = """
Turning joints have {:g} deg at most: a first session drives through all
of the limits. Widen them where nothing is in the way and the marker is seen."""


@click.command()
@options.folder
@options.as_json
def check(folder: Path) -> None:
    """List what an arm's folder lacks (missing, implausible, unmeasured) and what was measured.

    DIR may be its arm.yaml. Reads that and the servo, camera and marker files beside it, compares
    them with each other, and computes at how many poses the cameras see the marker. Lists the
    declared beams, whether the arm stands or hangs, and the sag of the arm held out; compare them
    with the real arm. The exit code is 3 if something is missing or implausible, and 0 if values
    are only unmeasured. Values that `servo setup`, `stereo calibrate` and `stereo hand-eye` wrote
    count as measured until they are changed.

    \b
    Example:
      longarm check my_arm
    """
    from longarm_comp.arm_folder.check import check_folder

    found = check_folder(folder)
    print_json([vars(finding) for finding in found])
    for finding in found:
        say(f"{finding.level:12}{finding.where}: {finding.text}")
    if all(finding.level in ("measured", "declared") for finding in found):
        note("nothing is missing, implausible or unmeasured")
    blocking = sum(finding.blocks for finding in found)
    if blocking:
        raise JobError(f"{folder} cannot be used yet", to_put_right=blocking)
