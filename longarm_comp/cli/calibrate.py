"""``longarm calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import error_row, note, print_json, print_rows, print_table, progress

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.effects.effect import Bias, Effect
    from longarm_comp.core.identify.fit import ModelFit


@click.command()
@options.arm
@options.session
@options.output("model.yaml", "Calibrated model to write.")
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="NAME",
    help="Effect to fit besides, on every joint or beam that may have it; repeat for more.",
)
@click.option("--no-deflection", is_flag=True, help="Leave the declared beams stiff.")
@click.option("--fraction", type=float, default=0.2, show_default=True, help="Rows held out.")
@options.seed
@options.effects
@options.as_json
def command(
    arm: Path,
    session: Path,
    output: Path,
    effects: tuple[str, ...],
    no_deflection: bool,
    fraction: float,
    seed: int,
    as_json: bool,
) -> None:
    """Fit geometry and declared effects of ARM to SESSION (CSV or bag).

    A ladder of ever fuller models is fitted without the held-out blocks and judged on them;
    the last is then fitted to all rows and written with 95 % intervals.

    \b
    Examples:
      longarm calibrate arm.yaml samples.csv -o model.yaml
      longarm calibrate arm.yaml samples.csv --effect joint_compliance --effect bearing_tilt
    """
    from longarm_comp import __version__
    from longarm_comp.cli.inputs import admitted
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.data.holdout import blocked_split
    from longarm_comp.core.identify.calibrate import ladder
    from longarm_comp.core.identify.fit import fit
    from longarm_comp.core.model.model_file import save_model, store

    declared = Arm.load(arm)
    chosen = [(name, _instances(name, declared)) for name in effects]
    whole = admitted(session, declared)
    train, held_out = blocked_split(whole, fraction, rng=seed)
    steps = 5 + len(chosen)
    with progress("calibrate") as show:
        done = iter(range(steps))
        rungs = ladder(
            declared,
            train,
            held_out,
            chosen,
            deflection=not no_deflection,
            progress=lambda name: show(name, next(done) / steps),
        )
        show("all rows", (steps - 1) / steps)
        final = fit(rungs[-1].model, whole)
    provenance: dict[str, str | int | float] = {
        "session_hash": whole.hash,
        "session": whole.source,
        "rows": len(final.session),
        "seed": seed,
        "longarm_comp": __version__,
    }
    save_model(output, store(final.model, final.standard_errors, provenance=provenance))
    geometry = len(rungs) - len(chosen)
    for before, rung in zip(rungs[geometry - 1 :], rungs[geometry:], strict=False):
        if rung.held_out.rms >= before.held_out.rms:
            note(f"{rung.name} did not lower the held-out error: better left out")
    rows = [error_row(rung.name, rung.held_out) for rung in rungs]
    if as_json:
        print_json({"output": str(output), "held_out": rows, **_facts(final, whole.hash)})
        return
    print_rows(f"Held-out errors ({len(held_out)} of {len(whole)} rows)", rows)
    shown = [p for p in _parameters(final) if not p["geometry"]]
    if shown:
        cells = [(p["effect"], p["where"], p["name"], *_value(p)) for p in shown]
        header = ("effect", "where", "parameter", "value", "95 % interval", "unit")
        print_table("Effects, fitted to all rows", header, cells)
    note(f"{len(final.outliers)} rows left out as outliers; model in {output}")
    if not final.converged:
        note(f"the last step was not below a hundredth of the errors after {final.iterations}")


def _instances(name: str, arm: Arm) -> tuple[Effect | Bias, ...]:
    from longarm_comp.core.effects.catalogue import effect_class
    from longarm_comp.core.errors import InputError

    made = effect_class(name, "--effect").for_arm(arm)
    if not made:
        raise InputError("--effect", name, "no place on this arm", "an effect this arm can have")
    return made


def _parameters(final: ModelFit) -> list[dict[str, Any]]:
    return [
        {
            "effect": slot.owner.name,
            "where": slot.owner.where,
            "name": slot.parameter.name,
            "value": value,
            "unit": slot.parameter.unit,
            "ci95": [value - 1.96 * se, value + 1.96 * se],
            "geometry": slot.owner.geometry,
        }
        for slot, value, se in zip(
            final.slots, final.model.values, final.standard_errors, strict=True
        )
    ]


def _value(p: dict[str, Any]) -> tuple[str, str, str]:
    low, high = p["ci95"]
    return f"{p['value']:.4g}", f"{low:.4g} .. {high:.4g}", p["unit"]


def _facts(final: ModelFit, session_hash: str) -> dict[str, Any]:
    return {
        "parameters": _parameters(final),
        "sigma_mm": 1e3 * final.sigma,
        "outliers": final.session.index[final.outliers],
        "converged": final.converged,
        "session_hash": session_hash,
    }
