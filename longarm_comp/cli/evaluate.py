"""``longarm evaluate``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import error_row, note, print_json, print_rows


@click.command()
@options.arm
@options.path_option("--test", "Measured poses (CSV or bag).", required=True)
@options.model
@options.predictor
@options.as_json
def command(
    arm: Path, test: Path, model: Path | None, predictor: Path | None, as_json: bool
) -> None:
    """Errors of every stage on measured poses, as in the paper's Table I.

    Rows: the rigid declared arm, with its declared deflection, the calibrated model, and with the
    network. A pose outside the network's training data keeps the physics' prediction.

    \b
    Example:
      longarm evaluate arm.yaml --test test.csv --model model.yaml --predictor predictor.npz
    """
    import numpy as np

    from longarm_comp.cli.inputs import admitted, physics, trained
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.identify.calibrate import Errors, errors

    declared = Arm.load(arm)
    calibrated = None if model is None else physics(declared, model)
    session = admitted(test, declared, calibrated, min_poses=1)
    stages = {"rigid": errors(physics(declared, None, False), session)}
    if declared.links:
        stages["deflection"] = errors(physics(declared, None), session)
    if calibrated is not None:
        stages["calibrated"] = errors(calibrated, session)
    outside = 0
    if predictor is not None:
        learned, deflection = trained(predictor, declared, model)
        seen = session.take(session.seen)
        found = learned.predict(seen.q, seen.context())
        inside = np.asarray(found.in_domain)
        outside = int((~inside).sum())
        expected = np.where(inside[:, None], found.error, 0.0)
        stages["network"] = errors(physics(declared, model, deflection), session) - expected
    rows = [error_row(name, Errors.of(error)) for name, error in stages.items()]
    if as_json:
        print_json({"test": str(test), "rows": rows, "outside_training_data": outside})
        return
    print_rows(f"Errors on {test} ({rows[0]['n']} poses)", rows)
    if outside:
        note(f"{outside} poses lie outside the network's training data: physics only")
