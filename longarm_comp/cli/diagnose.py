"""``longarm diagnose``, ``fleet`` and ``effects``: which effects of the library models lack."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_effects, print_json, print_rows, progress, say
from longarm_comp.core.errors import JobError

if TYPE_CHECKING:
    from longarm_comp.core.effects.fields import Parameter
    from longarm_comp.workflows.fleet import Diagnosed

_SHOWN = ("name", "unit", "prior", "unknown", "lower", "upper")


@click.command()
@options.arm
@options.session
@options.path_option("--test", "Hold-out (CSV or bag); default: blocks of SESSION.")
@options.path_option("--model", "Known model; its effects are not added again.")
@options.kind_of
@options.seed
@options.without("network", "Train no network on the remaining error.")
@options.output("diagnosis", "Folder to write.", outputs.DIAGNOSIS, outputs.diagnosis_files)
@options.effects
@options.as_json
def command(arm: options.Arm, session: Path, output: Path, **how: Any) -> None:
    """Find in SESSION (CSV or bag) the effects that ARM's model lacks, add them and prove them.

    Writes report.json, report.html, plots, and model.yaml with the effects found (longarm undo
    restores the version of --model). Also writes predictor.npz if a network lowered the error at
    rows left out of its training, and next_poses.csv if more poses would tell two effects apart.

    \b
    Examples:
      longarm diagnose arm.yaml samples.csv --test test.csv -o diagnosis
      longarm diagnose arm.yaml bag --model model.yaml -o diagnosis
      longarm diagnose arm.yaml samples.csv -o diagnosis --kind-of others/*.yaml
    """
    from longarm_comp.report.cards import cards, to_do
    from longarm_comp.workflows.diagnose import diagnose_files

    with progress("diagnose") as show:
        found = diagnose_files(arm, session, output, note=note, progress=show, **how)
    report = found.report
    print_json({"output": str(output), **report.model_dump(mode="json", by_alias=True)})
    rows = [row.model_dump() for row in report.held_out.rows]
    absent = {name for name in rows[0] if all(row[name] is None for row in rows)}
    shown = [{k: v for k, v in row.items() if k not in absent} for row in rows]
    print_rows(f"Held-out errors ({report.held_out.n} rows)", shown)
    added = [
        (f.name, p.where, p.name, p.value, p.ci95, p.unit)
        for f in report.findings
        for p in f.parameters
    ]
    print_effects("Effects added", report.called, added)
    split = {by.between[0] for by in found.diagnosis.splits}
    for duty, held in to_do(cards(report.for_people(), split)).items():
        for card in held:
            size = "; ".join(filter(None, (card.tip, card.sure, f"{card.figure} {card.improves}")))
            say(f"{duty.lower()}: {card.title} ({size}): {card.advice} {card.software}")
    say(f"{report.verdict}: {report.summary}")
    if report.nothing_gained:
        note(f"keep the model in use: longarm apply refuses this one. {report.nothing_gained}")
    note(found.diagnosis.set_aside.describe(found.diagnosis.fit.session))
    note(f"report in {output / 'report.html'}, model in {output / 'model.yaml'}")


@click.command()
@options.folder
@options.output(
    "fleet",
    "Folder to write: one diagnosis for each arm, fleet.json, fleet.html.",
    outputs.folder("fleet.json", told_by="fleet.json", schema="longarm/fleet/1"),
)
@click.option("--jobs", type=click.IntRange(min=1), default=1, help="Processes.")
@options.dask
@options.without("network", "Train no network on the remaining error.")
@options.seed
@options.as_json
def fleet(folder: Path, output: Path, **how: Any) -> None:
    """Diagnose every arm in DIR and compare them: which arm drifts, which effects all arms have.

    DIR has one folder for each arm, with arm.yaml, sessions (the newest is used) and, if there is
    one, the model.yaml in use. Or DIR has one arm.yaml and one session for each arm. Called again,
    the command continues, and diagnoses again what changed.

    \b
    Examples:
      longarm fleet examples/panda_touch -o fleet --jobs 2
      longarm fleet arms -o fleet --dask tcp://head:8786
    """
    from longarm_comp.core.files import write_text
    from longarm_comp.report.pages import fleet_page
    from longarm_comp.workflows.fleet import PAGE, fleet

    with progress("fleet") as show:
        arms = fleet(folder, output, progress=show, **how)
    write_text(output / PAGE, fleet_page(folder.resolve().name, [a.row for a in arms]))
    if all(arm.verdict == "failed" for arm in arms):
        raise JobError(f"no arm of {folder} could be diagnosed: {arms[0].summary}")
    print_json({"output": output, "arms": [arm.row for arm in arms]})
    print_rows(f"{len(arms)} arms", [_make_row(arm) for arm in arms])
    for arm in arms:
        if arm.verdict == "failed":
            note(f"{arm.name}: {arm.summary}")
        if arm.has_drifted:
            note(
                f"{arm.name} drifted: its model errs by {arm.in_use_mm:.2f} mm, a calibration of "
                f"today by {arm.calibrated_mm:.2f} mm"
            )
    note(f"page in {output / 'fleet.html'}; a diagnosis an arm and fleet.json beside it")


def _make_row(arm: Diagnosed) -> dict[str, Any]:
    found: dict[str, list[str]] = {}
    for f in arm.findings:
        found.setdefault(f.effect, []).append(f.where + " (of the kind)" * f.of_kind)
    effects = "; ".join(f"{effect} at {', '.join(where)}" for effect, where in found.items())
    return {
        "arm": arm.name,
        "rows": arm.rows,
        "verdict": arm.verdict,
        "in use, mm": arm.in_use_mm,
        "calibrated, mm": arm.calibrated_mm,
        "diagnosed, mm": arm.diagnosed_mm,
        "found": effects,
    }


@click.command()
@options.effects
@options.as_json
def effects() -> None:
    """Print the library of effects: parameters, units, priors, bounds, needed inputs.

    \b
    Example:
      longarm effects
      longarm effects --json
      longarm effects --effects my_effects.py
    """
    from longarm_comp.core.effects.catalogue import origin, registered
    from longarm_comp.core.effects.effect import Bias

    facts, lines = [], []
    for name, kind in registered().items():
        meaning = " ".join((kind.__doc__ or "").split("\n\n")[0].split())
        source, parameters = origin(kind), kind.declared()
        facts.append(
            {
                "effect": name,
                "side": "camera" if issubclass(kind, Bias) else "arm",
                "geometry": kind.geometry,
                "from": source or "longarm_comp",
                "meaning": meaning,
                "needs": kind.needs,
                "parameters": [{key: getattr(p, key) for key in _SHOWN} for p in parameters],
            }
        )
        listed = "; ".join(map(_in_words, parameters))
        where = f" ({source})" if source else ""
        lines.append(
            {
                "effect": name,
                "what": meaning + where,
                "parameters (unit, prior, bounds)": listed or "none",
                "needs": ", ".join(kind.needs),
            }
        )
    print_json(facts)
    print_rows(f"{len(lines)} effects", lines)


def _in_words(p: Parameter) -> str:
    bounds = [f"{sign} {end:g}" for sign, end in ((">=", p.lower), ("<=", p.upper))]
    given = [text for text in bounds if "inf" not in text]
    return f"{p.name} ({', '.join([p.unit, 'unknown' if p.unknown else f'{p.prior:g}', *given])})"
