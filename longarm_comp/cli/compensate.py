"""``longarm compensate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_rows
from longarm_comp.core.errors import InputError, JobError


@click.command(context_settings={"ignore_unknown_options": True})
@options.arm
@click.argument("numbers", nargs=-1, metavar="[X Y Z [QX QY QZ QW]]")
@options.path_option("--targets", "Targets (CSV) instead of one on the command line.")
@options.path_option("--path", "Way-points (CSV as targets, t_s where timed), in their order.")
@click.option(
    "--max-velocity", type=float, help="Largest velocity of every joint along --path, rad/s or m/s."
)
@click.option("--max-acceleration", type=float, help="The same, rad/s^2 or m/s^2.")
@click.option(
    "--max-longer",
    type=click.FloatRange(0.0),
    help="Share of time that play may add to --path; 0: exact times. Default 1.",
)
@options.model
@options.predictor
@options.known_network
@options.choice(
    "--method",
    ["none", "deflection", "network", "both"],
    "What to compensate; default: all that the given files allow.",
)
@options.choice(
    "--frame",
    ["base", "measured"],
    "Frame of the targets: the arm's own base, or that of the measurements of MODEL.",
)
@click.option("--seed-q", help="Joints to start from, q1,..,qn (rad, m); default mid-range.")
@click.option(
    "--lock", "locked", multiple=True, metavar="ROW|NAME", help="Joint that stays at its seed."
)
@options.path_option(
    "--history",
    "Session right before the targets: how the joints moved. The targets follow it in order.",
)
@options.without("run_up", "Joints move directly, from any side.")
@options.flag("--position-only", "Leave the orientation free.")
@options.flag("--single-pass", "Correct once, as the paper does.")
@click.option(
    "--realisable/--no-realisable",
    default=True,
    help="Choose joints together among the servo steps of ARM; off for paths.",
)
@options.output("commands.csv", "Joint commands to write.", outputs.COMMANDS)
@options.like
@options.effects
@options.as_json
def command(
    arm: options.Arm,
    numbers: tuple[str, ...],
    targets: Path | None,
    path: Path | None,
    model: Path | None,
    predictor: Path | None,
    method: str | None,
    seed_q: str | None,
    locked: tuple[str, ...],
    run_up: bool,
    realisable: bool,
    output: Path,
    like: Path | None,
    **alike: Any,
) -> None:
    """Joint commands of ARM that bring its real tip to targets (m).

    A column or --frame states the frame of the targets: base is the arm's own, measured is that of
    the rows with which MODEL was calibrated. commands.csv has one line per target, with the
    expected error (expected_mm) and the error that 90 of 100 commands stay below (p90_mm). If a
    target fails, its line holds the reason and the exit code is 3. approach_q* is the side from
    which each joint must arrive, run_up_q* the point to go to first. With --path the way-points are
    passed without a stop: t_s and v_q* are times and velocities. If one way-point cannot be
    reached, nothing is written.

    \b
    Examples:
      longarm compensate arm.yaml 0.9 -0.1 0.2 --model model.yaml --predictor predictor.npz
      longarm compensate arm.yaml --targets targets.csv --model model.yaml --lock 7
      longarm compensate arm.yaml --path waypoints.csv --model model.yaml --max-velocity 0.4
    """
    from longarm_comp.sessions.targets import Targets, read_targets
    from longarm_comp.workflows.compensate import Commands, compensate, method_of
    from longarm_comp.workflows.compensate_path import compensate_path
    from longarm_comp.workflows.inputs import choose_physics, load_predictor

    target = [_to_number(v) for v in numbers]  # first: a misspelt option is among them
    if (bool(numbers), targets is not None, path is not None).count(True) != 1:
        allowed = "one of X Y Z, --targets FILE, --path FILE"
        raise InputError("compensate", "target", list(numbers), allowed)
    of_paths = ("max_velocity", "max_acceleration", "max_longer")
    along = {name: v for name in of_paths if (v := alike.pop(name)) is not None}
    for name in along if path is None else ():
        flag = "--" + name.replace("_", "-")
        raise InputError("compensate", flag, along[name], "with --path alone")
    base = choose_physics(arm, model)
    form, output = options.form_of(like, output)
    given = (targets or path, *([form.read] if form else []))
    wanted = read_targets(*given) if targets or path else Targets.one(target)
    learned = load_predictor(predictor, arm, model) if predictor else None
    chosen = method_of(method, learned)
    alike |= {"method": chosen, "seed": None if seed_q is None else _parse_joints(seed_q, arm)}
    alike["locked"] = [_find_place(v, arm) for v in locked]
    answers: Commands
    if path is None:
        answers = compensate(base, wanted, learned, run_up=run_up, realisable=realisable, **alike)
    else:
        answers = found = compensate_path(base, wanted, learned, **along, **alike)
        for text in found.notes:
            note(text)
    answers.save(output, *([form.write] if form else []))
    commands = answers.lines()
    rows = [_make_row(c, arm.n) for c in commands]
    facts = {"output": output, "method": chosen.value, "frames": answers.frames}
    print_json({**facts, "commands": rows})
    if len(rows) == 1 and commands[0]["q1"] is not None:
        print_rows(f"Command (in {output})", rows)
    for text in answers.frames:
        note(text)
    failed = [c for c in commands if c["q1"] is None]
    if failed:
        raise JobError(
            "target {index}: {status}: {reason}".format_map(failed[0]),
            failed=f"{len(failed)} of {len(commands)}",
        )
    note(f"{len(commands)} commands in {output}{answers.promise}")


def _to_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError("compensate", "target", text, "numbers in m, or a known option") from None


def _parse_joints(text: str, arm: options.Arm) -> np.ndarray:
    try:
        q = np.array([float(v) for v in text.split(",")])
    except ValueError:
        q = np.empty(0)
    if q.shape != (arm.n,) or not np.isfinite(q).all():
        allowed = f"{arm.n} finite numbers with commas between (rad, m)"
        raise InputError("compensate", "--seed-q", text, allowed)
    return q


def _find_place(joint: str, arm: options.Arm) -> int:
    """Return the index in q of a joint, given by its name or the number of its DH row."""
    rows = map(str, arm.commanded)
    places = {word: k for words in (rows, arm.joint_names) for k, word in enumerate(words)}
    if joint not in places:
        raise InputError("compensate", "--lock", joint, f"a commanded joint: {', '.join(places)}")
    return places[joint]


def _make_row(line: dict[str, Any], n: int) -> dict[str, object]:
    names = ("index", "status", "frame", *(["reason"] if line["reason"] else []))
    run_up = [line[f"run_up_q{j}"] for j in range(1, n + 1)]
    figures = ("sigma_mm", "expected_mm", "p90_mm", "passes")
    return {
        **{name: line[name] for name in (*names, *(f"q{j}" for j in range(1, n + 1)))},
        **({} if None in run_up else {"run_up": run_up}),
        **{name: line[name] for name in figures},
    }
