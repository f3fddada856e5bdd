"""``longarm train``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, progress


@click.command()
@options.arm
@options.session
@options.model
@options.output("predictor.npz", "Predictor to write.", outputs.PREDICTOR)
@click.option("--init", type=click.Choice(["ssa", "xavier"]), default="ssa")
@click.option(
    "--inputs",
    type=click.Choice(["context", "joints"]),
    default="context",
    help="context: joints, approach, temperature, payload; joints: as in the paper.",
)
@click.option(
    "--ensemble", type=click.IntRange(min=1), default=5, help="Number of networks in the ensemble."
)
@click.option(
    "--hidden", type=click.IntRange(min=1), help="Hidden units; default: chosen by evidence."
)
@options.without("deflection", 'The paper\'s "network only": rigid physics.')
@options.seed
@options.effects
@options.as_json
def command(arm: Path, session: Path, output: Path, as_json: bool, **how: Any) -> None:
    """Train SSA-BP on the residual that the physics of ARM leaves in SESSION (CSV or bag).

    A network that does not help at poses left out of its training is not written.

    \b
    Examples:
      longarm train arm.yaml samples.csv --model model.yaml -o predictor.npz
      longarm train arm.yaml samples.csv --no-deflection --inputs joints -o network_only.npz
    """
    import numpy as np

    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.workflows.train import train

    with progress("train") as show:
        trained = train(Arm.load(arm), session, note=note, progress=show, **how)
    if trained.gain.helps:
        trained.save(output)
    facts = {
        "output": str(output) if trained.gain.helps else None,
        "samples": trained.samples,
        "training_mean_mm": {
            "before": 1e3 * trained.before.mean,
            "after": 1e3 * trained.after.mean,
        },
        "left_out_mean_mm": {
            "before": 1e3 * trained.gain.without,
            "after": 1e3 * trained.gain.left,
        },
        "noise_mm": 1e3 * np.asarray(trained.noise),
        "hidden": trained.hidden,
        "inputs": list(trained.encoding.names),
    }
    if as_json:
        print_json(facts)
        return
    done = (
        f"predictor in {output}"
        if trained.gain.helps
        else "not written: the physics alone is as good"
    )
    note(f"{trained.summary}; {done}")
