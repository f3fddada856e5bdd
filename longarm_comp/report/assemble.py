"""Converts a diagnosis to report.json and to the data of its page, deterministically."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from longarm_comp.core.data.commanded import commandable, not_commanded
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.aliasing import EffectFinding
from longarm_comp.core.identify.calibrate import Errors
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.evidence import key
from longarm_comp.core.identify.in_words import left_in_words
from longarm_comp.core.identify.practical import Gain, Practical, practical
from longarm_comp.core.identify.visible_size import Smallest
from longarm_comp.report.candidate_states import candidate_rows, sizes
from longarm_comp.report.detail import Detail
from longarm_comp.report.discovered import KEY, discovered
from longarm_comp.report.drawing import SPLITS, detail
from longarm_comp.report.noise_floor import ErrorFigures, NoiseFloor, excess, noise_floor
from longarm_comp.report.record import SCHEMA
from longarm_comp.version import __version__

NO_STRUCTURE: dict[str, Any] = {
    "flag": False,
    "text": "",
    "p_value": None,
    "share_explained": None,
    "inputs": [],
    "size_mm": None,
}


def assemble(
    diagnosis: Diagnosis, data_sha256: str, facts: Mapping[str, str] | None = None
) -> tuple[dict[str, Any], Detail]:
    """report.json and the page's detail.

    Args:
        diagnosis: what was found.
        data_sha256: of the rows that were given.
        facts: further provenance for the page; ``session`` becomes its title.
    """
    tried = sizes(diagnosis)
    return record_of(diagnosis, tried, data_sha256), detail(diagnosis, tried, facts or {})


def record_of(
    diagnosis: Diagnosis, tried: tuple[Smallest, ...], data_sha256: str
) -> dict[str, Any]:
    """report.json.

    Args:
        diagnosis: what was found.
        tried: all candidates outside the model (`candidate_states.sizes`).
        data_sha256: of the rows that were given.
    """
    structure, noise = diagnosis.structure, diagnosis.search.noise
    sigma = _position_noise(diagnosis)
    final = diagnosis.fit if diagnosis.added is None else diagnosis.added.fit
    real = practical(final, [f.terms for f in diagnosis.findings], diagnosis.held_out)
    return {
        "schema": SCHEMA,
        "verdict": diagnosis.verdict,
        "summary": diagnosis.summary,
        "findings": [
            _finding(diagnosis, f, one) for f, one in zip(diagnosis.findings, real, strict=True)
        ],
        "candidates": candidate_rows(diagnosis, tried),
        "structure_left": {
            "flag": structure.flag,
            "text": left_in_words(structure),
            "p_value": None if structure.sign else structure.p_value,
            "share_explained": structure.share_explained,
            "inputs": list(structure.inputs),
            "size_mm": 1e3 * structure.size_m,
        },
        "noise": {
            "sigma_mm": None if sigma is None else [1e3 * float(s) for s in sigma],
            "source": noise.source,
            "rho": float(noise.rho),
        },
        "held_out": _held_out(diagnosis, sigma),
        "next_poses": [
            [float(v) for v in q]
            for by in diagnosis.split_by
            if by.log_bayes_factor >= SPLITS
            for q in by.q
        ]
        + ([] if diagnosis.added is None else diagnosis.added.next_q.tolist()),
        "outliers": _outliers(diagnosis),
        KEY: discovered(diagnosis.discovery),
        "provenance": _provenance(diagnosis.seed, data_sha256, len(diagnosis.holdout_uses)),
    }


def refused(
    error: InputError, seed: int, title: str, data_sha256: str = ""
) -> tuple[dict[str, Any], Detail]:
    """The report of data that were not admitted."""
    report = {
        "schema": SCHEMA,
        "verdict": "bad_data",
        "summary": str(error),
        "findings": [],
        "candidates": [],
        "structure_left": NO_STRUCTURE,
        "noise": {"sigma_mm": None, "source": None, "rho": None},
        "held_out": {"n": 0, "rows": [], "before_after_ci95_mm": None},
        "next_poses": [],
        "outliers": [],
        KEY: [],
        "provenance": _provenance(seed, data_sha256, 0),
    }
    return report, Detail(title=title)


def _provenance(seed: int, data_sha256: str, uses: int) -> dict[str, Any]:
    return {
        "seed": seed,
        "data_sha256": data_sha256,
        "version": __version__,
        "holdout_uses": uses,
    }


def _finding(diagnosis: Diagnosis, found: EffectFinding, real: Practical) -> dict[str, Any]:
    places = {key(t) for t in found.terms}
    parameters = []
    for k, slot in enumerate(diagnosis.fit.slots):
        if key(slot.owner) not in places:
            continue
        interval = diagnosis.confirmed.intervals[k]
        parameters.append(
            {
                "name": slot.parameter.name,
                "where": slot.owner.where,
                "value": interval.value,
                "unit": slot.parameter.unit,
                "ci95": None if interval.at_bound else [interval.low, interval.high],
                "prior_scale": slot.parameter.prior,
            }
        )
    runner, first = found.runner_up, found.terms[0]
    called = diagnosis.arm.called
    tip_mm = 1e3 * real.tip_m
    return {
        "effect": found.name,
        "title": first.heading(),
        "reading": "; ".join(dict.fromkeys(t.reading for t in found.terms if t.reading)),
        "set": list(found.names),
        "untold": list(found.untold),
        "unnamed": found.unnamed,
        "where": list(found.where),
        "called": {p: w for p, w in called.items() if p in found.where},
        "log_bayes_factor": found.log_bayes_factor,
        "parameters": parameters,
        "runner_up": None
        if runner is None
        else {"effect": runner.candidate.name, "log_bayes_factor": runner.log_bayes_factor},
        "compensated": all(commandable(t) for t in found.terms),
        "tip_mm": {"median": float(np.median(tip_mm)), "max": float(tip_mm.max())},
        "seen_mm": _pair_mm(real.seen),
        "commanded_mm": _pair_mm(real.commanded),
        "stable": diagnosis.confirmed.stable[found.name],
        "doubts": [*diagnosis.confirmed.notes[found.name], *_overlapping(diagnosis, found.name)],
        "action": first.advice(diagnosis.arm),
    }


def _overlapping(diagnosis: Diagnosis, name: str) -> list[str]:
    """Which other findings would take most of what is its, in words."""
    named = {f.name for f in diagnosis.findings}
    pairs = (set(o.names) for o in diagnosis.confirmed.overlaps)
    others = [other for pair in pairs if name in pair for other in pair - {name} if other in named]
    return [f"{other} alone explains most of what both do" for other in others]


def _pair_mm(gain: Gain) -> list[float]:
    return [1e3 * gain.before, 1e3 * gain.after]


def _position_noise(diagnosis: Diagnosis) -> np.ndarray | None:
    """(3,) noise of the first sensor that measures positions, m; None where none measures all."""
    sigma = diagnosis.search.noise.sigma[:3]
    first = diagnosis.train.blocks[0].kind
    return sigma if first == "position" and np.isfinite(sigma).all() else None


def _held_out(diagnosis: Diagnosis, sigma: np.ndarray | None) -> dict[str, Any]:
    """Figures of all stages, and what was gained, as seen and as commanded."""
    rows = diagnosis.rows
    floor = None
    if sigma is not None:
        left = (rows["with_effects"].rms, diagnosis.structure.size_m)
        figures = [_figures(errors) for errors in rows.values()]
        flagged = left if diagnosis.structure.flag else None
        floor = noise_floor(tuple(map(float, sigma)), len(diagnosis.held_out), figures, flagged)
    before, after = diagnosis.compared
    added = after != "calibrated"
    intervals = (diagnosis.seen_gain.ci95, diagnosis.commanded_gain.ci95)
    seen, commanded = ([1e3 * g for g in gain] if added else None for gain in intervals)
    return {
        "n": len(diagnosis.held_out),
        "rows": [
            _error_row(name, errors, diagnosis.commanded[name], floor)
            for name, errors in rows.items()
        ],
        "before": before,
        "after": after,
        "before_after_ci95_mm": seen,
        "commanded_ci95_mm": commanded,
        "not_commanded": not_commanded(diagnosis.model, diagnosis.held_out),
    }


def _figures(errors: Errors) -> ErrorFigures:
    return ErrorFigures(
        errors.mean, errors.rms, errors.p95, errors.max, errors.mean_abs_z, errors.variance
    )


def _error_row(
    name: str, errors: Errors, commanded: np.ndarray, floor: NoiseFloor | None
) -> dict[str, Any]:
    return {
        "model": name,
        "mean_mm": 1e3 * errors.mean,
        "commanded_mean_mm": 1e3 * float(np.linalg.norm(commanded, axis=1).mean()),
        "rms_mm": 1e3 * errors.rms,
        "p95_mm": 1e3 * errors.p95,
        "max_mm": 1e3 * errors.max,
        "mean_abs_z_mm": 1e3 * errors.mean_abs_z,
        "variance_mm2": 1e6 * errors.variance,
        "excess_mm": 1e3 * excess(errors.rms, floor),
        "mean_mrad": None if errors.angle is None else 1e3 * errors.angle,
    }


def _outliers(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    fit, rows = diagnosis.fit, list[dict[str, Any]]()
    points = fit.session.labels.get("point", np.full(len(fit.session), ""))
    noise = fit.uneven(fit.session)[:, None] * fit.sigma
    for row in fit.outliers:
        length = float(np.linalg.norm(fit.residual[row] * fit.metres))
        ratio = float(np.max(np.abs(fit.residual[row]) / noise[row]))
        why = f"{1e3 * length:.1f} mm off, {ratio:.0f} standard deviations on its worst axis"
        rows.append({"index": int(fit.session.index[row]), "why": why, "point": str(points[row])})
    lost = fit.session.lost.items()
    return rows + [{"index": index, "why": f"not measured: {why}"} for index, why in lost]
