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
@options.choice("--init", ["ssa", "xavier"], "Initial weights.", default="ssa")
@options.choice(
    "--inputs", ["context", "joints"], default="context",
    what="context: joints, approach, temperature, payload; joints: as in the paper.",
)  # fmt: skip
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
def command(arm: options.Arm, session: Path, output: Path, **how: Any) -> None:
    """Train SSA-BP on the residual that the physics of ARM leaves in SESSION (CSV or bag).

    A network that does not help at poses left out of its training is not written.

    \b
    Examples:
      longarm train arm.yaml samples.csv --model model.yaml -o predictor.npz
      longarm train arm.yaml samples.csv --no-deflection --inputs joints -o network_only.npz
    """
    from longarm_comp.workflows.train import train

    with progress("train") as show:
        trained = train(arm, session, note=note, progress=show, **how)
    gain, done = trained.gain, "not written: the physics alone is as good"
    if gain.helps:
        trained.save(output)
        done = f"predictor in {output}"
    pairs = {
        "training_mean_mm": (trained.before.mean, trained.after.mean),
        "left_out_mean_mm": (gain.without, gain.left),
    }
    print_json(
        {
            "output": output if gain.helps else None,
            "samples": trained.samples,
            **{key: {"before": 1e3 * a, "after": 1e3 * b} for key, (a, b) in pairs.items()},
            "noise_mm": [1e3 * sigma for sigma in trained.noise],
            "hidden": trained.hidden,
            "inputs": trained.encoding.names,
        }
    )
    note(f"{trained.summary}; {done}")
