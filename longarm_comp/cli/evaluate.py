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
    network. A pose outside the network's training data keeps the physics' prediction. A test
    session that the model or the network was fitted to is pointed out.

    \b
    Example:
      longarm evaluate arm.yaml --test test.csv --model model.yaml --predictor predictor.npz
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.workflows.evaluate import evaluate

    made = evaluate(Arm.load(arm), test, model=model, predictor=predictor, note=note)
    rows = made.rows
    if made.fitted:
        note(f"the {' and the '.join(made.fitted)} came from this session: judge on other poses")
    if as_json:
        facts = {"outside_training_data": made.outside, "fitted_to_test": made.fitted}
        print_json({"test": str(test), "rows": rows, **facts})
        return
    print_rows(f"Errors on {test} ({rows[0]['n']} poses)", rows)
    if made.outside:
        note(f"{made.outside} poses lie outside the network's training data: physics only")
