"""``make soak``: `python -m soak` with the folder `test` on the path."""

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import click

sys.path.append(str(Path(__file__).parents[2]))  # bench, from any folder

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_rows, print_table, progress
from longarm_comp.cli.run import run_command
from longarm_comp.cli.signals import stop_on_signals
from longarm_comp.core.errors import JobError
from soak.run import soak
from soak.setting import SoakSettings

_LEAKS = {True: "yes", False: "no", None: "not judged"}


@click.command()
@click.option("--hours", default=1.0, show_default=True)
@click.option("--rate", default=20.0, show_default=True, help="Targets a second.")
@click.option("--fault-every", default=20.0, show_default=True, help="Mean time between faults, s.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of its files; else temporary.")
@options.seed
@options.as_json
def command(hours: float, rate: float, fault_every: float, out: Path | None, seed: int) -> None:
    """Send targets to a simulated arm for hours while random faults occur.

    Nodes are killed and frozen, files overwritten, servos and cameras silent, replies damaged,
    targets, images and parameters malformed, the clock jumps, and the emergency stop is pressed.
    Every target must be answered once, every command sent once and
    every refusal explained. After each fault a target must be answered with status 0 and the
    joints must go there. No process may crash or grow. The exit code is 3 if one fails.

    \b
    Examples:
      make soak
      make soak SOAK_ARGS='--hours 0.02 --fault-every 5 --json'
    """
    # Two soaks on one machine must not hear each other: their graphs have the same names
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    with (
        tempfile.TemporaryDirectory(prefix="longarm_soak_") as scratch,
        stop_on_signals() as stop,
        progress("soak") as show,
    ):
        setting = SoakSettings(out or Path(scratch), hours, rate, fault_every, seed=seed)
        report = soak(setting, stop, show)
    print_json(report)
    _show(report)
    if not report["passed"]:
        raise JobError("the soak found faults", **report["wrong"], **report["crashes"])


def _show(report: dict[str, Any]) -> None:
    for title in ("faults", "refusals", "wrong", "crashes"):
        if report[title]:
            print_table(title, ("what", "times"), list(report[title].items()))
    rows = [
        {
            "process": g["name"],
            "memory_mb": f"{g['memory_mb'][0]:.0f} -> {g['memory_mb'][1]:.0f}",
            "handles": f"{g['handles'][0]} -> {g['handles'][1]}",
            "leaks": _LEAKS[g["leaks"]],
        }
        for g in report["growth"]
    ]
    print_rows("processes, after the warm-up -> at the end", rows)
    judged = report["leaks_judged"]
    if judged < len(rows):
        note(f"leaks: {len(rows) - judged} of {len(rows)} processes ran too short to be judged")
    for why, times in report["driver_faults"].items():
        note(f"the driver was reset {times} times, which no fault explains: {why}")
    note(f"learned from {report['learned_from']} sightings")
    verdict = "passed" if report["passed"] else "failed"
    held = f", {report['held_back']} held back" if report["held_back"] else ""
    if report["driver_refusals"]:
        note(f"the driver refused {report['driver_refusals']} trajectories")
    note(f"{report['targets']} targets in {report['seconds']:.0f} s{held}: {verdict}")


if __name__ == "__main__":
    sys.exit(run_command(command, name="soak"))
