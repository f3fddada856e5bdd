"""``longarm apply`` and ``longarm undo``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import kept_if_broken_off, note, print_json, progress, say
from longarm_comp.cli.signals import on_graph


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
def undo(model: Path) -> None:
    """Restore the version of MODEL before the last change, byte for byte.

    The predictor that belonged to that version is restored too. A predictor of the version that is
    taken back is set aside. Running nodes notice the change.

    \b
    Example:
      longarm undo model.yaml
    """
    from longarm_comp.workflows import apply as workflow

    back = workflow.undo(model)
    note(f"{model} is the previous version again")
    if back is not None:
        note(f"{back} is the predictor that belongs to it")
