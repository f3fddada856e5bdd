"""``longarm collect`` and ``touch``: sessions of a running arm, driven or guided by hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import (
    kept_if_broken_off,
    note,
    print_json,
    print_table,
    progress,
    progress_hidden,
)
from longarm_comp.cli.signals import handle_signals, on_graph
from longarm_comp.core.errors import InputError, JobError

if TYPE_CHECKING:
    from longarm_comp.jobs.collect.run import Collected, Progress
    from longarm_comp.jobs.collect.visits import PlanCheck, Visit
    from longarm_comp.jobs.touch import TouchLog

_HELP = "Enter: record a touch; NAME: next point; plane NAME: next plane; undo; end"


@click.command()
@options.arm_file
@options.path_argument("poses", "POSES")
@options.written_option("-o/--output", "Bag folder to record.", outputs.left_to_the_command)
@options.flag("--dry-run", "Move nothing; print what the plan would do.")
@options.floor
@options.choice(
    "--sides",
    ["plan", "random", "both"],
    default="plan",
    what="Sides of arrival: of the plan, random, or both of the plan and opposite.",
)
@click.option("--repeats", default=0, help="Poses that are visited two more times.")
@options.flag("--in-order", "Drive in the order of the file instead of a random order.")
@options.pace
@options.flag("--resume", "Continue an interrupted recording.")
@click.option(
    "--payload",
    "payload_kg",
    type=click.FloatRange(min=0),
    help="Mass at the tool now, kg; default: as another node publishes it, else it asks.",
)
@click.option(
    "--give-up",
    type=click.IntRange(min=0),
    default=6,
    help="End if none of this many first poses shows the marker; 0: never.",
)
@options.namespace
@options.seed
@options.as_json
def collect(
    arm: Path,
    poses: Path,
    output: Path | None,
    dry_run: bool,
    floor: float | None,
    sides: str,
    repeats: int,
    in_order: bool,
    pace: options.Paced,
    namespace: str,
    seed: int,
    **how: Any,
) -> None:
    """Drive ARM through the plan POSES over ROS and record a session bag.

    At each pose every joint makes a run-up from its side and rests; then several sightings are
    averaged. Ctrl-C ends the recording: the bag then holds all completed poses, and --resume adds
    the others. The command waits while the driver is held (longarm hold).

    If POSES states payloads, the poses of one payload are driven together, and the command asks
    before it goes on with another one. Where nobody answers, it leaves those poses for --resume.

    \b
    Examples:
      longarm collect arm.yaml poses.csv --dry-run
      longarm collect arm.yaml poses.csv -o session_1
      longarm collect arm.yaml poses.csv -o session_1 --sides both --repeats 10 --resume
    """
    from longarm_comp.arm_folder.head import view_beside
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.data.plan import from_both_sides, with_floor, with_random_sides
    from longarm_comp.core.model.declared_model import declared_model
    from longarm_comp.jobs.collect.visits import (
        list_visits,
        plan_checks,
        refuse_blocked,
        servos_beside,
    )
    from longarm_comp.sessions.poses import read_poses

    if output is None and not dry_run:
        raise InputError("collect", "-o", None, "a bag folder to record, or --dry-run")
    declared = Arm.load(arm)
    plan = read_poses(poses, declared, inside=not dry_run)
    other = {"random": with_random_sides, "both": from_both_sides}.get(sides)
    if other is not None:
        plan = other(declared, plan, seed)
    todo = list_visits(plan, declared, repeats=repeats, shuffle=not in_order, seed=seed)
    bounded = declared if floor is None else with_floor(declared, floor)
    view = view_beside(arm)
    checks = plan_checks(bounded, todo, view=view, servos=servos_beside(arm, declared.joint_names))
    if dry_run:
        _show_plan(declared.name, todo, checks)
        return
    refuse_blocked(checks, todo, poses)
    assert output is not None
    how |= {"pace": pace(declared_model(declared), plan.q), "view": view}
    done = _drive_visits(bounded, todo, output, namespace, **how)
    print_json({"bag": output, **vars(done)})
    before = f", {done.before} before" if done.before else ""
    note(f"{done.made} visits made{before}, of {done.planned}; bag in {output}")
    if done.unseen:
        note(f"the marker was not seen at visits {', '.join(map(str, done.unseen))}")
    if done.blocked:
        kinds = {text.partition(": ")[0]: text for text in done.blocked.values()}
        left = f"{len(done.blocked)} of {done.planned} poses were not driven"
        why = "; ".join(kinds.values())
        raise JobError(f"{left} ({why}); --resume adds them, with --payload after a change of it")


def _drive_visits(
    arm: options.Arm, todo: Sequence[Visit], output: Path, namespace: str, **how: Any
) -> Collected:
    """Run `collect`; if it ends early, print what is kept and what to do next."""
    from longarm_comp.jobs.collect import run

    last: list[Progress] = []

    def say_kept() -> str:
        if not last or not (output / "metadata.yaml").is_file():
            return ""
        made, seen = len(last[-1].made), last[-1].seen_count
        told = f"driven in this run: {made} of {len(todo)} visits, marker seen at {seen}"
        return f"{told}; {output} keeps them, the same command with --resume adds the others"

    def follow(now: Progress) -> None:
        last[:] = [now]
        show(str(now), now.share)

    def attach(kg: float, visits: int) -> bool:
        question = f"{visits} poses need {kg:g} kg at the tool. Does the arm carry it now? (y/N)"
        return _ask_line(question, client.stop).lower() in ("y", "yes")

    with (
        kept_if_broken_off(say_kept),
        on_graph("collect", namespace, arm) as client,
        progress("collect", lines=True) as show,
    ):
        return run.collect(client, todo, output, attach=attach, progress=follow, **how)


def _show_plan(name: str, todo: Sequence[Visit], checks: Sequence[PlanCheck]) -> None:
    from longarm_comp.jobs.collect.visits import blocked_visits

    count = len(todo)
    print_json(
        {
            "visits": count,
            "checks": [
                {
                    "question": c.question,
                    "passed": c.passed_count,
                    "blocks": c.blocks,
                    "faults": {v.index: f for v, f in zip(todo, c.faults, strict=True) if f},
                }
                for c in checks
            ],
        }
    )
    for kg, of_it in Counter(visit.payload_kg for visit in todo).items():
        if kg is not None:
            note(f"{of_it} visits with {kg:g} kg at the tool")
    rows = [(c.question, f"{c.passed_count} of {count}", c.common_faults) for c in checks]
    print_table(f"{name}: {count} visits", ("visits", "yes", "where not"), rows)
    if stopped := blocked_visits(checks, todo):
        raise JobError(f"{len(stopped)} of {count} visits cannot be driven")


@click.command()
@options.arm
@options.output(
    "touches.csv", "Session to write; it is written after every touch.", outputs.left_to_the_command
)
@click.option("--name", default="a", help="Name of the first point.")
@click.option(
    "--distance",
    "distances",
    type=(str, str, click.FloatRange(min=0, min_open=True)),
    multiple=True,
    metavar="A B M",
    help="Known distance of two points, m; repeat for more.",
)
@click.option(
    "--tolerance-mm",
    type=click.FloatRange(min=0, min_open=True),
    default=0.1,
    help="Standard deviation of these distances.",
)
@options.flag(
    "--by-hand", "Switch the torque off meanwhile: hold the arm before you start, and at the end."
)
@options.flag("--resume", "Add to an existing session.")
@options.namespace
@options.as_json
def touch(
    arm: options.Arm,
    output: Path,
    name: str,
    distances: tuple[tuple[str, str, float], ...],
    tolerance_mm: float,
    by_hand: bool,
    resume: bool,
    namespace: str,
) -> None:
    """Record the joints of ARM's running graph while its tip touches points; one key a touch.

    Guide the arm by hand, or jog it, until the ball sits in the socket, and press Enter. The
    command sends nothing to the arm, except that --by-hand switches the torque off, and on again at
    the end. After some touches it prints how far each touch is from its point. If `contact` is
    published on the graph (by a wire to ball and socket, or by the simulated arm's `sockets`), a
    touch outside the socket is refused.

    \b
    Examples:
      longarm touch arm.yaml -o touches.csv --distance left_0 left_1 0.050 --name left_0
      longarm touch arm.yaml -o touches.csv --resume --by-hand
    """
    from longarm_comp.jobs.touch import TouchLog, release_servos
    from longarm_comp.sessions.csv import merge_distances, read_touches
    from longarm_comp.sessions.read import read_session

    given = [(*known, 1e-3 * tolerance_mm) for known in distances]
    touches = TouchLog(arm, merge_distances(read_touches(output), given, str(output)))
    if output.exists() and not resume:
        raise InputError(str(output), "session", "exists", "a new file, or --resume")
    if output.exists():
        touches.begin_with(read_session(output, arm))

    written = len(touches)

    def say_kept() -> str:
        return f"{output} keeps {written} touches; --resume adds to them" if written else ""

    with (
        kept_if_broken_off(say_kept),
        on_graph("touch", namespace, arm) as client,
        release_servos(client) if by_hand else nullcontext(""),
    ):
        note(_HELP)
        column, line = "touch", _ask_line(f"touch {name}", client.stop)
        while line != "end":
            if not line:
                try:
                    touches.take(client, name, column)
                except JobError as error:
                    if client.stop.is_set():
                        raise
                    note(str(error))
            elif line == "undo":
                touches.undo()
            elif line.startswith("plane "):
                column, name = "plane", line.removeprefix("plane ")
            else:
                column, name = "touch", line
            if line in ("", "undo"):
                _keep_touches(touches, output)
                written = len(touches)
            line = _ask_line(f"{column} {name}", client.stop)
    print_json({"output": output, "rows": written})
    file = click.get_current_context().params["arm"]
    done = f"{written} touches in {output}; next: longarm calibrate {file} {output}"
    note(done if written else "no touch was recorded, nothing is written")


def _ask_line(prompt: str, stop: Event) -> str:
    """Return the next line of input; ``end`` at its end. A signal ends the wait at once."""

    def now(*_: object) -> None:
        stop.set()
        raise KeyboardInterrupt

    try:
        with handle_signals(now), progress_hidden():
            return str(click.prompt(prompt, default="", show_default=False, err=True)).strip()
    except click.Abort:
        if stop.is_set():
            raise
        return "end"


def _keep_touches(touches: TouchLog, output: Path) -> None:
    from longarm_comp.sessions.csv import write_csv

    if not len(touches):
        output.unlink(missing_ok=True)
        return
    session = touches.session()
    write_csv(session, output)
    spread = touches.spread_m()
    said = f"{len(touches)} rows"
    if spread is not None:
        said += f"; {1e3 * spread.mean():.2f} mm from their points in the mean"
        if session.labels["touch"][-1]:
            said += f", the last one {1e3 * spread[-1]:.2f} mm"
    note(said)
