"""``longarm train``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, progress


@click.command()
@options.arm
@options.session
@options.model
@options.output("predictor.npz", "Predictor to write.")
@click.option("--init", type=click.Choice(["ssa", "xavier"]), default="ssa", show_default=True)
@click.option(
    "--inputs",
    type=click.Choice(["context", "joints"]),
    default="context",
    show_default=True,
    help="context: joints, approach, temperature, payload; joints: as in the paper.",
)
@click.option(
    "--ensemble",
    type=click.IntRange(min=1),
    default=5,
    show_default=True,
    help="Networks, each from its own start.",
)
@click.option(
    "--hidden", type=click.IntRange(min=1), help="Hidden units; by evidence if not given."
)
@click.option("--no-deflection", is_flag=True, help='The paper\'s "network only": rigid physics.')
@click.option(
    "--device", help="torch device of the sparrow search, such as cuda; numpy if not given."
)
@options.seed
@options.as_json
def command(
    arm: Path,
    session: Path,
    model: Path | None,
    output: Path,
    init: str,
    inputs: str,
    ensemble: int,
    hidden: int | None,
    no_deflection: bool,
    device: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Train SSA-BP on what the physics of ARM leaves of SESSION (CSV or bag).

    \b
    Examples:
      longarm train arm.yaml samples.csv --model model.yaml -o predictor.npz
      longarm train arm.yaml samples.csv --no-deflection --inputs joints -o network_only.npz
    """
    import numpy as np

    from longarm_comp.cli.inputs import admitted, physics, physics_mark
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.identify.calibrate import Errors, errors
    from longarm_comp.core.learn.ensemble import train
    from longarm_comp.core.learn.predictor import Provenance

    declared = Arm.load(arm)
    base = physics(declared, model, not no_deflection)
    whole = admitted(session, declared, None if model is None else base)
    seen = whole.take(whole.seen)
    residual = errors(base, seen)
    origin = Provenance(
        declared.hash,
        whole.hash,
        declared.joint_names,
        physics_mark(model, not no_deflection),
    )
    with progress("train") as show:
        made = train(
            seen.q,
            residual,
            seen.context(),
            inputs=inputs,
            init=init,
            seed=seed,
            ensemble=ensemble,
            hidden=hidden,
            progress=lambda k, of: show(f"{k} of {of} networks", k / of),
            provenance=origin,
            device=device,
        )
    made.save(output)
    left = residual - made.predict(seen.q, seen.context()).error
    before, after = Errors.of(residual), Errors.of(left)
    facts = {
        "output": str(output),
        "samples": len(seen),
        "training_mean_mm": {"before": 1e3 * before.mean, "after": 1e3 * after.mean},
        "noise_mm": 1e3 * np.asarray(made.noise),
        "hidden": made.hidden,
        "inputs": list(made.encoding.names),
    }
    if as_json:
        print_json(facts)
        return
    note(
        f"{len(seen)} samples: mean error {1e3 * before.mean:.2f} -> {1e3 * after.mean:.2f} mm on "
        f"the training rows (judge it with evaluate); predictor in {output}"
    )
