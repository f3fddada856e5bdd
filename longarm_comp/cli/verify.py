"""``longarm verify``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click
import numpy as np

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import (
    as_text,
    kept_if_broken_off,
    note,
    print_json,
    print_rows,
    progress,
    say,
)
from longarm_comp.cli.signals import on_graph
from longarm_comp.core.errors import JobError

_BROKEN_OFF = (
    "an interrupted verification keeps nothing; model and predictor are unchanged; "
    "`longarm status` shows the state of the arm, and the same command starts again"
)


@click.command()
@options.arm
@options.path_option("--targets", "CSV with x, y, z (m); default: random targets.")
@click.option("-n", "count", type=click.IntRange(min=2), default=40,
              help="Random targets.")  # fmt: skip
@options.path_option("--model", "Model whose tip gives random targets; default: ARM.")
@options.choice("--method", ["deflection", "network", "both"],
                "Compensation to measure; default: that of the running node.")  # fmt: skip
@options.choice("--by", ["cameras", "readings"], "What measures the tip.", default="cameras")
@options.pace
@options.namespace
@options.seed
@options.written(
    "-o/--output",
    "Folder for verify.json and verify.png.",
    outputs.folder("verify.json", "verify.png", told_by="verify.json"),
)
@options.effects
@options.as_json
def command(
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
    from longarm_comp.core.compensation.compensate import Method
    from longarm_comp.core.data.plan import random_targets, sobol
    from longarm_comp.core.files import write_text
    from longarm_comp.jobs.targets import (
        Draw,
        TargetRunner,
        choose,
        method_at_work,
        one_by_one,
        verify,
    )
    from longarm_comp.nodes import interfaces as graph
    from longarm_comp.sessions.targets import read_targets
    from longarm_comp.workflows.inputs import physics

    drawn_from, rng = physics(arm, model), np.random.default_rng(seed)
    draw: Draw = partial(random_targets, drawn_from, rng=rng)
    if targets is not None:
        given = read_targets(targets).xyz
        draw, count = one_by_one(given), len(given)
    paced = pace(drawn_from, sobol(arm, 16, seed).q)
    tips = graph.TIP_BY_READINGS if by == "readings" else graph.TIP_MEASURED
    with on_graph("verify", namespace, arm, tips=tips) as client, progress("verify") as show:
        client.ready()
        with kept_if_broken_off(lambda: _BROKEN_OFF):
            runner = TargetRunner(client, paced)
            runner.ready(drawn_from.tip(arm.mid), 30.0)
            judged = Method(method) if method else method_at_work(client)
            kept, refused = choose(runner, draw, count, (Method.NONE, judged))
            result, report = verify(runner, kept, refused, judged, seed=seed, progress=show)
    if output is not None:
        write_text(output / "verify.json", as_text(report))
        result.picture(output / "verify.png")
        note(f"picture in {output / 'verify.png'}")
    print_json(report)
    print_rows(f"tip - target over {report['targets']} targets", result.rows)
    for xyz, why in refused:
        note(f"target {xyz.round(4).tolist()} was left out: {why}")
    counts = ", ".join(f"{name} {n}" for name, n in report["status"].items())
    note(f"{len(refused)} targets refused; with compensation: {counts}")
    say(result.summary)
    if not result.helps:
        raise JobError(result.summary)
