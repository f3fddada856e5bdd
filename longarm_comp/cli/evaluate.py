"""``longarm evaluate``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_rows


@click.command()
@options.arm
@options.path_option("--test", "Measured poses (CSV or bag).", required=True)
@options.model
@options.predictor
@options.effects
@options.as_json
def command(
    arm: Path, test: Path, model: Path | None, predictor: Path | None, as_json: bool
) -> None:
    """Errors of every stage on measured poses, as in the paper's Table I.

    Rows: the rigid declared arm, with its declared deflection, the calibrated model, and with the
    network. At poses outside the network's training data the physics is used alone. A note appears
    if the model or the network was fitted to the test session.

    \b
    Example:
      longarm evaluate arm.yaml --test test.csv --model model.yaml --predictor predictor.npz
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.workflows.evaluate import evaluate

    evaluation = evaluate(Arm.load(arm), test, model=model, predictor=predictor, note=note)
    rows = evaluation.rows
    if evaluation.fitted:
        note(f"the {' and the '.join(evaluation.fitted)} came from this session: use other poses")
    if evaluation.placed:
        note("the declared arm was placed by these rows first: they see it somewhere else")
    if as_json:
        facts = {
            "outside_training_data": evaluation.outside,
            "fitted_to_test": evaluation.fitted,
            "placed": evaluation.placed,
        }
        print_json({"test": str(test), "rows": rows, **facts})
        return
    print_rows(f"Errors on {test} ({rows[0]['n']} poses)", rows)
    if evaluation.outside:
        note(f"{evaluation.outside} poses lie outside the network's training data: physics only")
