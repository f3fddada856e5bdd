"""Causes without a name in report.json."""

from __future__ import annotations

from typing import Any

from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.identify.discover.discovery import Cause, Discovery

KEY = Discovered.name
"""Causes without a name are called the same in model.yaml and in report.json."""


def discovered(discovery: Discovery | None) -> list[dict[str, Any]]:
    """What was found, largest first, with the hold-out without and with it; empty for nothing."""
    if discovery is None:
        return []
    return [_cause(found, discovery) for found in discovery.found]


def _cause(found: Cause, discovery: Discovery) -> dict[str, Any]:
    before, after = (discovery.proof.rows[k].rms for k in ("calibrated", "with_effects"))
    at = [a.where.partition(", ") for a in found.amounts]
    return {
        "frame": ", ".join(dict.fromkeys(frame for frame, _, _ in at)),
        "component": ", ".join(dict.fromkeys(component for _, _, component in at)),
        "set": list(found.where),
        "formula": found.formula,
        "reading": found.reading,
        "title": found.terms[0].heading(),
        "action": found.terms[0].action,
        "doubts": list(discovery.doubts),
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
        "compensated": found.compensated and discovery.kept,
        "kept": discovery.kept,
        "held_out_rms_mm": [1e3 * before, 1e3 * after],
    }
