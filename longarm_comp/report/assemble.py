"""Converts a diagnosis to report.json and to the data of its page, deterministically."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.data.commanded import not_commanded
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.discover.causes import Cause
from longarm_comp.core.identify.findings import EffectFinding, left_in_words
from longarm_comp.core.identify.practical import Gain, Practical, practical
from longarm_comp.core.identify.proof import WITH_EFFECTS, WITH_FUNCTIONS
from longarm_comp.report.candidate_states import Smallest, candidate_rows, sizes
from longarm_comp.report.detail import SPLITS, Detail, detail
from longarm_comp.report.noise_floor import FIGURES, excess, noise_floor
from longarm_comp.report.record import SCHEMA, DiscoveredTerm
from longarm_comp.version import __version__

_TERM = tuple(DiscoveredTerm.model_fields)
KEY = Discovered.name
"""Causes without a name are called the same in model.yaml and in report.json."""


def _cause(found: Cause, diagnosis: Diagnosis) -> dict[str, Any]:
    before, after = (diagnosis.proof.rows[k].rms for k in (WITH_EFFECTS, WITH_FUNCTIONS))
    at = [a.where.partition(", ") for a in found.amounts]
    kept = diagnosis.written == WITH_FUNCTIONS
    return {
        "frame": ", ".join(dict.fromkeys(frame for frame, _, _ in at)),
        "component": ", ".join(dict.fromkeys(component for _, _, component in at)),
        "set": list(found.where),
        "names": dict(found.names),
        "probability": found.probability,
        "formula": found.formula,
        "reading": found.reading,
        "title": found.terms[0].heading(),
        "action": found.terms[0].action,
        "doubts": list(diagnosis.doubts),
        "domain": list(found.domain),
        "terms": [{key: getattr(a, key) for key in _TERM} for a in found.amounts],
        "ci95": [list(a.ci95) for a in found.amounts],
        "log_evidence": found.log_evidence,
        "tip_mm": {"rms": 1e3 * found.tip_m[0], "max": 1e3 * found.tip_m[1]},
        "compensated": found.compensated and kept,
        "kept": kept,
        "held_out_rms_mm": [1e3 * before, 1e3 * after],
    }


def assemble(
    diagnosis: Diagnosis, data_sha256: str, facts: Mapping[str, str] | None = None
) -> tuple[dict[str, Any], Detail]:
    """report.json and the page's detail; of `facts`, ``session`` becomes the page's title."""
    tried = sizes(diagnosis)
    return record_of(diagnosis, tried, data_sha256), detail(diagnosis, tried, facts or {})


def record_of(
    diagnosis: Diagnosis, tried: tuple[Smallest, ...], data_sha256: str
) -> dict[str, Any]:
    """report.json; ``tried``: all candidates outside the model (`candidate_states.sizes`)."""
    structure, noise = diagnosis.structure, diagnosis.search.noise
    sigma = _position_noise(diagnosis)
    terms = [f.terms for f in diagnosis.findings]
    real = practical(diagnosis.search.fit, terms, diagnosis.fullest)
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
        "proof": {
            "folds": diagnosis.proof.folds,
            "rows": len(diagnosis.held_out),
            "passed": not diagnosis.failed,
            "why": diagnosis.failed,
        },
        "set_aside": diagnosis.set_aside.record,
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
        + diagnosis.next_q.tolist(),
        "outliers": _outliers(diagnosis),
        KEY: [_cause(cause, diagnosis) for cause in diagnosis.causes],
        "none_of_these": diagnosis.none_of_these,
        "written": {
            "model": diagnosis.written,
            "expected_commanded_mm": {k: 1e3 * v for k, v in diagnosis.expected.items()},
        },
        "doubtful": [
            {
                "effect": f.name,
                "where": list(dict.fromkeys(t.where for t in f.terms)),
                "probability": f.there,
            }
            for f in diagnosis.search.doubtful
        ],
        "called": diagnosis.arm.called,
        "provenance": _provenance(diagnosis.seed, data_sha256, diagnosis.proof.folds),
    }


def refused(
    error: InputError, seed: int, title: str, data_sha256: str = ""
) -> tuple[dict[str, Any], Detail]:
    """The report of data that were not admitted."""
    report: dict[str, Any] = {
        "schema": SCHEMA,
        "verdict": "bad_data",
        "summary": str(error),
        **{key: [] for key in ("findings", "candidates", "next_poses", "outliers")},
        "structure_left": {"flag": False, "inputs": []},
        "noise": {},
        "held_out": {"n": 0, "rows": []},
        "provenance": _provenance(seed, data_sha256, 0),
    }
    return report, Detail(title=title)


def _provenance(seed: int, data_sha256: str, folds: int) -> dict[str, Any]:
    return {
        "seed": seed,
        "data_sha256": data_sha256,
        "version": __version__,
        "holdout_uses": [f"every row once, {folds} folds"] if folds else [],
    }


def _finding(diagnosis: Diagnosis, found: EffectFinding, real: Practical) -> dict[str, Any]:
    ends, parameters = diagnosis.intervals_of(found), []
    written = {t.key for t in diagnosis.model.terms}
    left_out = written.isdisjoint(t.key for t in found.terms)
    for slot in diagnosis.search.fit.slots:
        interval = ends.get((*slot.owner.key, slot.parameter.name))
        if interval is None:
            continue
        parameters.append(
            {
                "name": slot.parameter.name,
                "where": slot.owner.where,
                "value": interval.value,
                "unit": slot.parameter.unit,
                "ci95": None if interval.at_bound or left_out else [interval.low, interval.high],
                "prior_scale": slot.parameter.prior,
            }
        )
    runner, first = found.runner_up, found.terms[0]
    tip_mm = 1e3 * real.tip_m
    return {
        "effect": found.name,
        "title": first.heading(),
        "reading": "; ".join(dict.fromkeys(t.reading for t in found.terms if t.reading)),
        "set": list(found.names),
        "probability": found.probability,
        "set_probability": {name: p for name, p in found.chances if name in found.names},
        "unnamed": found.unnamed,
        "where": list(found.where),
        "log_bayes_factor": found.log_bayes_factor,
        "parameters": parameters,
        "runner_up": None
        if runner is None
        else {"effect": runner.candidate.name, "log_bayes_factor": runner.log_bayes_factor},
        "compensated": all(t.commandable for t in found.terms) and not left_out,
        "tip_mm": {"median": float(np.median(tip_mm)), "max": float(tip_mm.max())},
        "seen_mm": _pair_mm(real.seen),
        "commanded_mm": _pair_mm(real.commanded),
        "doubts": [f"{p.name} could stand for its {p.part}" for p in found.partial_aliases],
        "action": first.advice(diagnosis.arm),
    }


def _pair_mm(gain: Gain) -> list[float]:
    return [1e3 * gain.before, 1e3 * gain.after]


def _position_noise(diagnosis: Diagnosis) -> np.ndarray | None:
    """(3,) noise of the first sensor, m; None where it does not tell all of a place."""
    sigma = diagnosis.search.noise.sigma[:3]
    first = diagnosis.train.blocks[0].kind
    return sigma if first in ("position", "touch") and np.isfinite(sigma).all() else None


def _held_out(diagnosis: Diagnosis, sigma: np.ndarray | None) -> dict[str, Any]:
    proof = diagnosis.proof
    rows = {n: _error_row(n, e, proof.commanded[n]) for n, e in proof.rows.items()}
    floor = None
    if sigma is not None:
        left = 1e3 * diagnosis.structure.size_m if diagnosis.structure.flag else 0.0
        sigma_mm = [1e3 * float(s) for s in sigma]
        floor = noise_floor(sigma_mm, len(diagnosis.held_out), rows, diagnosis.written, left)
    before, after = diagnosis.compared
    added = after != "calibrated"
    intervals = (diagnosis.seen_gain.ci95, diagnosis.commanded_gain.ci95)
    seen, commanded = ([1e3 * g for g in gain] if added else None for gain in intervals)
    return {
        "n": len(diagnosis.held_out),
        "rows": [row | {"excess_mm": excess(row["rms_mm"], floor)} for row in rows.values()],
        "before": before,
        "after": after,
        "before_after_ci95_mm": seen,
        "commanded_ci95_mm": commanded,
        "not_commanded": not_commanded(diagnosis.model, diagnosis.held_out),
    }


def _error_row(name: str, errors: Errors, commanded: np.ndarray) -> dict[str, Any]:
    return {
        "model": name,
        **{name: errors.mm[name] for name in FIGURES},
        "commanded_mean_mm": 1e3 * float(np.linalg.norm(commanded, axis=1).mean()),
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
