"""``longarm apply``, ``undo``, ``verify`` and ``loop``: models in use on the running graph."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import kept_if_broken_off, note, print_json, print_rows, progress, say
from longarm_comp.cli.signals import on_graph, user_agrees
from longarm_comp.core.errors import JobError

if TYPE_CHECKING:
    from longarm_comp.report.record import DiagnosisReport

SHOWN = ("run", "n", "refused", "mean_mm", "rms_mm", "p95_mm", "max_mm", "mean_abs_z_mm")
_BROKEN_OFF = (
    "an interrupted verification keeps nothing; model and predictor are unchanged; "
    "`longarm status` shows the state of the arm, and the same command starts again"
)


@click.command()
@options.path_argument("diagnosis", "DIAGNOSIS")
@options.path_option("--session", "Session that was diagnosed; default: as DIAGNOSIS names it.")
@options.without("network", "Train no predictor.")
@options.namespace
@options.seed
@options.effects
@options.as_json
def apply(diagnosis: Path, namespace: str, **how: Any) -> None:
    """Use DIAGNOSIS, a folder that `longarm diagnose` wrote, on the running graph.

    Replaces the model file that kinematics was started with and trains the predictor again on
    the same session. Both nodes read their files again. A predictor that does not fit the new
    model is set aside. `longarm undo MODEL` restores both files in one step.

    A diagnosis is refused if it is of another arm, adds nothing, or was not made with the model in
    use.

    \b
    Example:
      longarm apply diagnosis
    """
    from dataclasses import asdict

    from longarm_comp.jobs.apply import apply_on_graph

    began: list[str] = []
    kept = "model and predictor in use fit each other; run the same command again to finish"

    def step(text: str, share: float) -> None:
        began.append(text)
        show(text, share)

    with (
        kept_if_broken_off(lambda: kept if began else ""),
        on_graph("apply", namespace) as client,
        progress("apply") as show,
    ):
        done = apply_on_graph(client, diagnosis, note=note, progress=step, **how)
    print_json({**asdict(done), "undo": done.undo})
    for change in done.changes:
        say(str(change))
    for name, pair in (("as commanded", done.commanded_mm), ("as seen", done.seen_mm)):
        if pair is not None:
            say(f"held-out mean error {name}: {pair[0]:.2f} -> {pair[1]:.2f} mm")
    note(f"{done.model} is version {done.version}; predictor: {done.predictor or 'none'}")
    if done.set_aside is not None:
        note(f"the predictor before is kept as {done.set_aside}")
    note(f"to take it back: {done.undo}")


@click.command()
@options.path_argument("model", "MODEL")
@options.path_option("--predictor", "Predictor in use, if it is in another folder than MODEL.")
def undo(model: Path, predictor: Path | None) -> None:
    """Restore the version of MODEL before the last change, byte for byte.

    The predictor that belonged to that version is restored too. A predictor of the undone
    version is set aside. Running nodes notice the change.

    \b
    Examples:
      longarm undo model.yaml
      longarm undo model.yaml --predictor learned/predictor.npz
    """
    from longarm_comp.workflows import model_in_use

    back = model_in_use.undo(model, predictor)
    note(f"{model} is the previous version again")
    if back is not None:
        note(f"{back} is the predictor that belongs to it")


@click.command()
@options.arm
@options.path_option(
    "--targets", "CSV with x, y, z alone (m, frame base); default: random targets."
)
@click.option("-n", "count", type=click.IntRange(min=2), default=40, help="Random targets.")
@options.path_option("--model", "Model whose tip gives random targets; default: ARM.")
@options.choice(
    "--method",
    ["deflection", "network", "both"],
    "Compensation to measure; default: that of the running node.",
)
@options.choice("--by", ["cameras", "readings"], "What measures the tip.", default="cameras")
@options.pace
@options.namespace
@options.seed
@options.written_option(
    "-o/--output",
    "Folder for verify.json and verify.png.",
    outputs.folder("verify.json", "verify.png", told_by="verify.json"),
)
@options.effects
@options.as_json
def verify(
    arm: options.Arm,
    targets: Path | None,
    count: int,
    model: Path | None,
    method: str | None,
    by: str,
    pace: options.Paced,
    namespace: str,
    seed: int,
    output: Path | None,
) -> None:
    """Drive fresh targets on ARM's running graph, without and with compensation.

    The cameras measure tip - target, and both runs are compared target by target. Targets that the
    graph refuses are left out and counted. The arm may be real or simulated. The graph's method is
    restored at the end. --by readings needs no camera: the tip is computed from the encoders and
    the model, so errors behind the encoders are known only as well as the model knows them. The
    exit code is 0 if the 95 % interval of the gain lies above 0, else 3.

    \b
    Examples:
      longarm verify arm.yaml -n 40
      longarm verify arm.yaml --targets targets.csv -o verified
    """
    from longarm_comp.core.compensation.result import Method
    from longarm_comp.core.data.plan import sobol
    from longarm_comp.core.files import write_text
    from longarm_comp.core.model.model import Model
    from longarm_comp.jobs import targets as job
    from longarm_comp.nodes import interfaces as graph
    from longarm_comp.sessions.targets import read_targets
    from longarm_comp.workflows.inputs import choose_physics

    drawn_from, rng = choose_physics(arm, model), np.random.default_rng(seed)
    draw = job.at_random(drawn_from, rng)
    if targets is not None:
        given = read_targets(targets).points
        draw, count = job.one_by_one(given), len(given)
    paced = pace(drawn_from, sobol(arm, 16, seed).q)
    tips = graph.TIP_BY_READINGS if by == "readings" else graph.TIP_SEEN
    with on_graph("verify", namespace, arm, tips=tips) as client, progress("verify") as show:
        client.ready()
        with kept_if_broken_off(lambda: _BROKEN_OFF):
            runner = job.TargetRunner(client, paced)
            runner.ready(Model(arm).tip(arm.mid), 30.0)
            judged = Method(method) if method else job.method_at_work(client)
            kept, refused = job.choose_targets(runner, draw, count, (Method.NONE, judged))
            result, report = job.verify(runner, kept, refused, judged, seed=seed, progress=show)
    if output is not None:
        write_text(output / "verify.json", outputs.json_text(report))
        result.picture(output / "verify.png")
        note(f"picture in {output / 'verify.png'}")
    print_json(report)
    print_rows(f"tip - target over {report['targets']} targets", result.rows)
    for xyz, why in refused:
        note(f"target {xyz.round(4).tolist()} was left out: {why}")
    counts = ", ".join(f"{name} {n}" for name, n in report["status"].items())
    note(f"{len(refused)} targets refused; with compensation: {counts}")
    if frame := report["placed_by_each_run"]:
        note(
            f"nobody knows where {frame!r} lies, so each run's sightings were laid on its targets: "
            "what moves or turns all of them alike is not seen"
        )
    say(result.summary)
    if not result.helps:
        raise JobError(result.summary)


@click.command()
@options.arm
@options.output(
    None,
    "New folder for sessions, diagnoses and the page.",
    outputs.begun_folder("steps.json"),
)
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
def loop(
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
    from longarm_comp.nodes import interfaces as graph

    paced = pace(declared_model(arm), sobol(arm, 16, seed).q)
    settings = LoopSettings(output, targets=targets, seed=seed, pace=paced, **size)

    def agree(report: DiagnosisReport) -> bool:
        note(f"{report.verdict}: {report.summary}")
        return user_agrees("Apply this to the model in use?", yes)

    kept = f"{output} keeps what was done; continue with --resume"
    with (
        kept_if_broken_off(lambda: kept if output.is_dir() else ""),
        on_graph("loop", namespace, arm, tips=graph.TIP_SEEN) as client,
        progress("loop") as show,
    ):
        _, printed = Loop(client, settings, agree, resume=resume, say=show).run()
    print_json(printed)
    rows = [{name: row[name] for name in SHOWN} for row in printed["rows"]]
    print_rows(f"tip - target over {targets} targets, measured by the cameras", rows)
    for r in printed["rounds"]:
        for why, count in r["not_driven"].items():
            note(f"round {r['number']}: {count} poses were not driven: {why}")
        for change in r["changes"]:
            say(f"round {r['number']}: {change['text']}")
    say(printed["summary"])
    note(f"ended: {printed['ended']}")
    note(f"page: {printed['files']['page']}; to take it back: {printed['undo']}")
    if not printed["helps"]:
        raise JobError(printed["summary"])
