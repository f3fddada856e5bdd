"""``longarm collect``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, progress


@click.command()
@options.arm
@click.argument("poses", type=click.Path(path_type=Path), metavar="POSES")
@options.output(None, "Bag folder to record.")
@click.option(
    "--sides",
    type=click.Choice(["plan", "random", "both"]),
    default="plan",
    show_default=True,
    help="Joints arrive from: the plan's sides; sides drawn per joint; these and their opposites.",
)
@click.option(
    "--repeats", default=0, show_default=True, help="Poses that are visited two more times."
)
@click.option("--in-order", is_flag=True, help="In the order of the file instead of a random one.")
@options.pace
@click.option("--resume", is_flag=True, help="Continue an interrupted recording.")
@options.namespace
@options.seed
@options.as_json
def command(
    arm: Path,
    poses: Path,
    output: Path,
    sides: str,
    repeats: int,
    in_order: bool,
    sightings: int,
    dwell: float,
    move: float,
    resume: bool,
    namespace: str,
    seed: int,
    as_json: bool,
) -> None:
    """Drive ARM through the plan POSES over ROS and record a session bag.

    At each pose every joint runs up from its side and rests, and several sightings are averaged.
    Ctrl-C ends it. The bag then holds all completed visits, and --resume adds the others.

    \b
    Examples:
      longarm collect arm.yaml poses.csv -o session_1
      longarm collect arm.yaml poses.csv -o session_1 --sides both --repeats 10 --resume
    """
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.data.plan import from_both_sides, with_random_sides
    from longarm_comp.jobs.client import ArmClient
    from longarm_comp.jobs.collect import Pace, collect
    from longarm_comp.jobs.measurement_schedule import visits
    from longarm_comp.sessions.poses import read_poses

    declared = Arm.load(arm)
    plan = read_poses(poses, declared)
    other = {"random": with_random_sides, "both": from_both_sides}.get(sides)
    if other is not None:
        plan = other(declared, plan, seed)
    todo = visits(plan, declared, repeats=repeats, shuffle=not in_order, seed=seed)
    pace = Pace(sightings=sightings, dwell_s=dwell, move_s=move)
    with (
        stop_on_signals() as stop,
        ArmClient(declared, namespace, stop, "collect") as client,
        progress("collect") as show,
    ):
        done = collect(client, todo, output, pace=pace, resume=resume, progress=show)
    if as_json:
        print_json({"bag": str(output), **vars(done)})
        return
    before = f", {done.before} before" if done.before else ""
    note(f"{done.made} visits made{before}, of {done.planned}; bag in {output}")
    if done.unseen:
        note(f"the marker was not seen at visits {', '.join(map(str, done.unseen))}")
