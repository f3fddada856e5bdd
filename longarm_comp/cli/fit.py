"""``longarm calibrate``, ``train`` and ``evaluate``: a model, its predictor, and their errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_effects, print_json, print_rows, progress


@click.command()
@options.arm
@options.session
@options.output("model.yaml", "Calibrated model to write.", outputs.MODEL)
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="NAME",
    help="Also fit this effect, at every joint or beam that may have it; repeat for more.",
)
@options.without("deflection", "Treat the declared beams as stiff.")
@click.option("--fraction", type=float, default=0.2, help="Share of rows held out.")
@options.kind_of
@options.seed
@options.effects
@options.as_json
def calibrate(arm: options.Arm, session: Path, output: Path, **how: Any) -> None:
    """Fit geometry and declared effects of ARM to SESSION (CSV or bag).

    Models of growing complexity are fitted without the held-out rows and compared on these. The
    last model is then fitted to all rows and written with 95 % intervals. Prints the places of base
    and sensors, with their uncertainty.

    \b
    Examples:
      longarm calibrate arm.yaml samples.csv -o model.yaml
      longarm calibrate arm.yaml samples.csv --effect joint_compliance --effect bearing_tilt
      longarm calibrate arm.yaml samples.csv --kind-of others/*.yaml
    """
    from longarm_comp.workflows.calibrate import calibrate

    with progress("calibrate") as show:
        calibration = calibrate(arm, session, note=note, progress=show, **how)
    calibration.save(output)
    if calibration.placed:
        note("the declared arm was first placed by the rows, because they see it at another place")
    for place in calibration.untold:
        note(f"the rows do not show {place}: left as declared")
    for part in calibration.far_off:
        note(f"far from the drawing: {part}; correct it there if it is wrong")
    for name in calibration.not_helping:
        note(f"{name} did not lower the held-out error: better leave it out")
    rows, final, aside = calibration.held_out.rows, calibration.fit, calibration.set_aside
    print_json(
        {
            "output": str(output),
            "held_out": rows,
            "parameters": [vars(p) for p in calibration.parameters],
            "sigma_mm": 1e3 * final.sigma,
            "outliers": final.session.index[final.outliers],
            "set_aside": aside.record,
            "converged": final.converged,
            "session_hash": calibration.session.hash,
            "placed": calibration.placed,
            "untold": calibration.untold,
            "far_off": calibration.far_off,
            "places": [vars(place) for place in calibration.places],
        }
    )
    print_rows(
        f"Held-out errors ({calibration.held_out_rows} of {len(calibration.session)} rows)", rows
    )
    print_rows(
        "Placed by all rows, in the frame of the measurements",
        [
            {
                "": place.where,
                "x y z, m": _round_three(place.xyz_m, 4),
                "1 sigma, mm": _round_three(place.sd_mm, 2),
                "roll pitch yaw, deg": _round_three(place.rpy_deg, 3),
                "1 sigma about x y z, deg": _round_three(place.sd_deg, 3),
            }
            for place in calibration.places
        ],
    )
    added = [p for p in calibration.parameters if not p.geometry]
    found = [(p.effect, p.where, p.name, p.value, p.ci95, p.unit) for p in added]
    print_effects("Effects, fitted to all rows", arm.names_for_people, found)
    note(f"{aside.describe(final.session)}; model in {output}")
    if not final.converged:
        note(
            "the fit did not converge: its last step was above a hundredth of the errors after "
            f"{final.iterations}"
        )


def _round_three(values: Sequence[float], digits: int) -> str:
    return " ".join(f"{value + 0.0:.{digits}f}" for value in values)


@click.command()
@options.arm
@options.session
@options.model
@options.output("predictor.npz", "Predictor to write.", outputs.is_predictor)
@options.choice("--init", ["ssa", "xavier"], "Initial weights; default: ssa.")
@options.choice(
    "--inputs",
    ["context", "joints"],
    default="context",
    what="context: joints, approach, temperature, payload; joints: as in the paper.",
)
@click.option(
    "--ensemble", type=click.IntRange(min=1), default=5, help="Number of networks in the ensemble."
)
@click.option(
    "--hidden", type=click.IntRange(min=1), help="Hidden units; default: chosen by evidence."
)
@options.without("deflection", 'The paper\'s "network only": rigid physics.')
@options.choice(
    "--device",
    ["auto", "cpu", "cuda"],
    default="auto",
    what="Where to train; auto: a GPU if torch sees one.",
)
@options.network
@options.seed
@options.effects
@options.as_json
def train(arm: options.Arm, session: Path, output: Path, **how: Any) -> None:
    """Train SSA-BP on the residual that the physics of ARM leaves in SESSION (CSV or bag).

    A network that does not help at poses left out of its training is not written.

    \b
    Examples:
      longarm train arm.yaml samples.csv --model model.yaml -o predictor.npz
      longarm train arm.yaml samples.csv --no-deflection --inputs joints -o network_only.npz
      longarm train arm.yaml samples.csv --network two_layers.py -o predictor.safetensors
    """
    from longarm_comp.core.learn.predictor_file import check_ending
    from longarm_comp.workflows.train import train

    check_ending(output, how["network"] is not None)
    with progress("train") as show:
        trained = train(arm, session, note=note, progress=show, **how)
    gain = trained.gain
    chance = gain.left < gain.without
    done = f"not written: {'the gain may be chance' if chance else 'the physics alone is as good'}"
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


@click.command()
@options.arm
@options.path_option("--test", "Measured poses (CSV or bag).", required=True)
@options.model
@options.predictor
@options.known_network
@options.effects
@options.as_json
def evaluate(arm: options.Arm, test: Path, model: Path | None, predictor: Path | None) -> None:
    """Errors of every stage on measured poses, as in the paper's Table I.

    The lines of the table are the rigid declared arm, the arm with its declared deflection, the
    calibrated model, and the model with the network. The worst rows of the last are named by their
    index. Every measured row counts: rows that do not fit the model are noted, not refused. If the
    rows show the declared arm at another place, it is first placed by them, provided that they hold
    at least twice the numbers that this takes. At poses outside the network's training data the
    physics is used alone. A note appears if the model or the network was fitted to the session.

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
            "elsewhere": evaluation.elsewhere,
        }
    )
    print_rows(f"Errors on {test} ({rows[0]['n']} poses)", rows)
    for text in evaluation.notes:
        note(text)
