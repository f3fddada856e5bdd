"""``longarm collect``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_table
from longarm_comp.core.errors import InputError, JobError, LongarmError

if TYPE_CHECKING:
    from longarm_comp.jobs.client import Pace
    from longarm_comp.jobs.collect.preview import Preview
    from longarm_comp.jobs.collect.progress import Progress
    from longarm_comp.jobs.collect.run import Collected

_LOOK_S = 0.2
"""Time of one sighting, where cameras take five pictures a second."""


@click.command()
@options.arm
@click.argument("poses", type=click.Path(path_type=Path), metavar="POSES")
@options.written("-o/--output", "Bag folder to record.", outputs.left_to_the_command)
@click.option("--dry-run", is_flag=True, help="Move nothing; print what the plan would do.")
@options.written("--picture", "Also draw the plan: FILE.png, .svg or .pdf.", outputs.PICTURE)
@options.floor
@click.option(
    "--sides",
    type=click.Choice(["plan", "random", "both"]),
    default="plan",
    show_default=True,
    help="Sides of arrival: of the plan, random, or both of the plan and opposite.",
)
@click.option(
    "--repeats", default=0, show_default=True, help="Poses that are visited two more times."
)
@click.option(
    "--in-order", is_flag=True, help="Drive in the order of the file instead of a random order."
)
@options.pace
@click.option("--resume", is_flag=True, help="Continue an interrupted recording.")
@click.option(
    "--give-up",
    type=click.IntRange(min=0),
    default=6,
    show_default=True,
    help="End if none of this many first poses shows the marker; 0: never.",
)
@options.namespace
@options.seed
@options.as_json
def command(
    arm: Path,
    poses: Path,
    output: Path | None,
    dry_run: bool,
    picture: Path | None,
    floor: float | None,
    sides: str,
    repeats: int,
    in_order: bool,
    pace: Callable[..., Pace],
    namespace: str,
    seed: int,
    as_json: bool,
    **how: Any,
) -> None:
    """Drive ARM through the plan POSES over ROS and record a session bag.

    At each pose every joint makes a run-up from its side and rests; then several sightings are
    averaged. Ctrl-Z pauses after this pose, and a second Ctrl-Z goes on. Ctrl-C ends the recording:
    the bag then holds all completed poses, and --resume adds the others. BAG_coverage.png shows for
    each pose whether it was measured.

    \b
    Examples:
      longarm collect arm.yaml poses.csv --dry-run --picture plan.png
      longarm collect arm.yaml poses.csv -o session_1
      longarm collect arm.yaml poses.csv -o session_1 --sides both --repeats 10 --resume
    """
    from longarm_comp.arm_folder.visible import view_beside
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.data.allowed_poses import above
    from longarm_comp.core.data.plan import from_both_sides, with_random_sides
    from longarm_comp.core.model.declared_model import declared_model
    from longarm_comp.jobs.collect.preview import preview, refuse_blocked, servos_beside
    from longarm_comp.jobs.measurement_schedule import visits
    from longarm_comp.sessions.poses import read_poses

    if output is None and not dry_run:
        raise InputError("collect", "-o", None, "a bag folder to record, or --dry-run")
    declared = Arm.load(arm)
    plan = read_poses(poses, declared, inside=not dry_run)
    other = {"random": with_random_sides, "both": from_both_sides}.get(sides)
    if other is not None:
        plan = other(declared, plan, seed)
    todo = visits(plan, declared, repeats=repeats, shuffle=not in_order, seed=seed)
    paced = pace(declared_model(declared), plan.q)
    bounded = declared if floor is None else above(declared, floor)
    ahead = preview(
        bounded, todo, view=view_beside(arm), servos=servos_beside(arm, declared.joint_names),
        rest_s=paced.dwell_s + _LOOK_S * paced.sightings,
    )  # fmt: skip
    if picture is not None:
        from longarm_comp.jobs.collect.picture import draw

        draw(ahead, ahead.faults(), picture, "can be measured", f"{declared.name}: {poses.name}")
    if dry_run:
        _show(ahead, picture, as_json)
        return
    refuse_blocked(ahead, poses)
    assert output is not None
    done = _drive(ahead, output, namespace, as_json, pace=paced, **how)
    if as_json:
        print_json({"bag": str(output), **vars(done)})
        return
    before = f", {done.before} before" if done.before else ""
    note(f"{done.made} visits made{before}, of {done.planned}; bag in {output}")
    if done.unseen:
        note(f"the marker was not seen at visits {', '.join(map(str, done.unseen))}")
    if done.blocked:
        why = next(iter(done.blocked.values()))
        note(f"{len(done.blocked)} poses were not driven, because no way there is free: {why}")


def _drive(ahead: Preview, output: Path, namespace: str, quiet: bool, **how: Any) -> Collected:
    """Collect; draw what became of each pose, also where it ends early."""
    from longarm_comp.cli.live import shown
    from longarm_comp.cli.signals import on_graph, pause_on_stop_key
    from longarm_comp.jobs.collect.run import collect

    made: dict[int, str] = {}

    def follow(now: Progress) -> None:
        made.update(now.made)
        show(now)

    done: Collected | None = None
    try:
        with (
            on_graph("collect", namespace, ahead.arm) as client,
            pause_on_stop_key() as pause,
            shown(ahead.arm, quiet) as show,
        ):
            done = collect(
                client, ahead.visits, output, view=ahead.view, pause=pause,
                progress=follow, **how,
            )  # fmt: skip
            return done
    finally:
        _end(ahead, made, output, whole=done is not None)


def _end(ahead: Preview, made: dict[int, str], output: Path, whole: bool) -> None:
    """What is kept, drawn and to be done next; whatever ended it is said after this."""
    if made:
        from longarm_comp.jobs.collect.picture import coverage  # takes a second

        try:
            note(f"coverage: {coverage(ahead, made, output)}")
        except (LongarmError, OSError) as error:
            note(f"no picture of the coverage: {error}")
    if not whole and (output / "metadata.yaml").is_file():
        seen = list(made.values()).count("")
        note(f"driven in this run: {len(made)} of {len(ahead.visits)} visits, marker seen "
             f"at {seen}; {output} keeps them, the same command with --resume adds the "
             "others")  # fmt: skip


def _show(ahead: Preview, picture: Path | None, as_json: bool) -> None:
    """What a plan would do, and whether `collect` would drive it."""
    count = len(ahead.visits)
    if as_json:
        print_json({
            "visits": count,
            "checks": [{"question": c.question, "passed": c.passed, "blocks": c.blocks,
                        "faults": {v.index: f for v, f in zip(ahead.visits, c.faults, strict=True)
                                   if f}} for c in ahead.checks],
            "unasked": [f"{asked}: {why}" for asked, why in ahead.unasked.items()],
            "lowest_m": ahead.lowest_m, "seconds": ahead.seconds,
        })  # fmt: skip
    else:
        rows = [(c.question, f"{c.passed} of {count}", c.mostly) for c in ahead.checks]
        rows += [(asked, "not checked", why) for asked, why in ahead.unasked.items()]
        print_table(f"{ahead.arm.name}: {count} visits", ("visits", "yes", "where not"), rows)
        note(f"the arm's lowest point is at z = {ahead.lowest_m:.3f} m")
        if ahead.seconds is not None:
            note(f"about {ahead.seconds / 60:.0f} min at the servos' speeds")
        if picture is not None:
            note(f"picture in {picture}")
    if ahead.blocked:
        raise JobError(f"{len(ahead.blocked)} of {count} visits cannot be driven")
