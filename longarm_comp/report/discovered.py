"""Causes without a name in report.json."""

from __future__ import annotations

from typing import Any

from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.identify.diagnosis import WITH_EFFECTS, WITH_FUNCTIONS, Diagnosis
from longarm_comp.core.identify.discover.causes import Cause

KEY = Discovered.name
"""Causes without a name are called the same in model.yaml and in report.json."""


def discovered(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """What was found, largest first, with the hold-out without and with it; empty for nothing."""
    return [_cause(cause, diagnosis) for cause in diagnosis.causes]


def _cause(found: Cause, diagnosis: Diagnosis) -> dict[str, Any]:
    before, after = (diagnosis.rows[k].rms for k in (WITH_EFFECTS, WITH_FUNCTIONS))
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
        "terms": [
            {
                "where": a.where,
                "function": a.function,
                "value": a.value,
                "ci95": list(a.ci95),
                "unit": a.unit,
            }
            for a in found.amounts
        ],
        "ci95": [list(a.ci95) for a in found.amounts],
        "log_evidence": found.log_evidence,
        "tip_mm": {"rms": 1e3 * found.tip_m[0], "max": 1e3 * found.tip_m[1]},
        "compensated": found.compensated and kept,
        "kept": kept,
        "held_out_rms_mm": [1e3 * before, 1e3 * after],
    }
