"""``longarm loop``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import kept_if_broken_off, note, print_json, print_rows, progress, say
from longarm_comp.cli.signals import agreed, on_graph
from longarm_comp.core.errors import JobError

if TYPE_CHECKING:
    from longarm_comp.report.record import DiagnosisReport

SHOWN = ("run", "n", "refused", "mean_mm", "rms_mm", "p95_mm", "max_mm", "mean_abs_z_mm")


@click.command()
@options.arm
@options.output(None, "Folder for sessions, diagnoses and the page.", outputs.left_to_the_command)
@options.flag("--yes", "Apply every diagnosis without asking.")
@click.option("--rounds", default=3, help="Rounds at most.")
@click.option("--poses", default=180, help="Poses to measure in a round.")
@click.option("--targets", default=40, help="Fresh targets to measure the gain.")
@options.without("network", "Train no predictor.")
@options.flag("--resume", "Go on with an interrupted loop.")
@options.pace
@options.namespace
@options.seed
@options.effects
@options.as_json
def command(
    arm: options.Arm,
    output: Path,
    yes: bool,
    targets: int,
    resume: bool,
    pace: options.Paced,
    namespace: str,
    seed: int,
    **size: Any,
) -> None:
    """Calibrate and check ARM on its running graph, real or simulated, in one command.

    First it drives to fresh targets, without compensation and with the present model. A round then
    plans poses, collects a session, diagnoses it and shows the result. If you answer yes, it
    applies the result, trains the predictor again and drives to the same targets again. Another
    round follows if the last one brought the tip nearer by more than chance, and the mean error is
    still more than twice what the noise of the measurement would show.

    The graph must have been started with --model FILE (and --predictor FILE); the files need not
    exist yet. The arm moves through its whole range: keep its surroundings clear. The exit code
    is 3 if the last run is not nearer to the targets than the one without compensation.

    \b
    Example:
      longarm up arm.yaml --sim --model work/model.yaml --predictor work/predictor.npz
      longarm loop arm.yaml -o loop_1
    """
    from longarm_comp.core.data.plan import sobol
    from longarm_comp.core.model.declared_model import declared_model
    from longarm_comp.jobs.loop import Loop, LoopSettings

    paced = pace(declared_model(arm), sobol(arm, 16, seed).q)
    settings = LoopSettings(output, targets=targets, seed=seed, pace=paced, **size)

    def agree(report: DiagnosisReport) -> bool:
        note(f"{report.verdict}: {report.summary}")
        return agreed("Apply this to the model in use?", yes)

    kept = f"{output} keeps what was done; continue with --resume"
    with (
        kept_if_broken_off(lambda: kept if output.is_dir() else ""),
        on_graph("loop", namespace, arm) as client,
        progress("loop") as show,
    ):
        _, printed = Loop(client, settings, agree, resume=resume, say=show).run()
    print_json(printed)
    rows = [{name: row[name] for name in SHOWN} for row in printed["rows"]]
    print_rows(f"tip - target over {targets} targets, measured by the cameras", rows)
    for r in printed["rounds"]:
        for change in r["changes"]:
            say(f"round {r['number']}: {change['text']}")
    say(printed["summary"])
    note(f"ended: {printed['ended']}")
    note(f"page: {printed['files']['page']}; to take it back: {printed['undo']}")
    if not printed["helps"]:
        raise JobError(printed["summary"])
