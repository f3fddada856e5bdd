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
def command(arm: options.Arm, test: Path, model: Path | None, predictor: Path | None) -> None:
    """Errors of every stage on measured poses, as in the paper's Table I.

    The lines of the table are the rigid declared arm, the arm with its declared deflection, the
    calibrated model, and the model with the network. The worst rows of the last are named by their
    index. Every measured row counts: rows that do not fit the model are noted, not refused. At
    poses outside the network's training data the physics is used alone. A note appears if the model
    or the network was fitted to the session.

    \b
    Example:
      longarm evaluate arm.yaml --test test.csv --model model.yaml --predictor predictor.npz
    """
    from longarm_comp.workflows.evaluate import evaluate

    evaluation = evaluate(arm, test, model=model, predictor=predictor, note=note)
    rows = evaluation.rows
    if evaluation.fitted:
        note(f"the {' and the '.join(evaluation.fitted)} came from this session: use other poses")
    worst = {
        name: [{"index": row, "error_mm": 1e3 * size} for row, size in errors.worst]
        for name, errors in evaluation.items()
    }
    print_json(
        {
            "test": str(test),
            "rows": rows,
            "worst": worst,
            "outside_training_data": evaluation.outside,
            "no_gain_promised": evaluation.refused,
            "fitted_to_test": evaluation.fitted,
            "placed": evaluation.placed,
        }
    )
    print_rows(f"Errors on {test} ({rows[0]['n']} poses)", rows)
    for text in evaluation.notes:
        note(text)
