"""A loop's result as plain data, for --json, the page and the table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from longarm_comp.core.files import write_text
from longarm_comp.jobs.loop.run import LoopResult, Round, compared
from longarm_comp.jobs.loop.settings import RULE, LoopSettings
from longarm_comp.report.loop_page import loop_page
from longarm_comp.workflows.verification import error_row


def write_loop(arm: str, settings: LoopSettings, result: LoopResult) -> dict[str, Any]:
    """Write ``loop.json`` and ``loop.html``; the contents of the former."""
    data = summary(arm, settings, result)
    write_text(settings.out / "loop.json", json.dumps(data, indent=2))
    write_text(
        settings.out / "loop.html", loop_page(data, {t.name: t.error for t in result.trials})
    )
    return data


def summary(arm: str, settings: LoopSettings, result: LoopResult) -> dict[str, Any]:
    """Everything that came of a loop."""
    last = result.rounds[-1]
    applied = [r.applied for r in result.rounds if r.applied is not None]
    return {
        "arm": arm,
        "rows": _rows(result),
        "helps": result.against_none.helps,
        "summary": result.against_none.summary,
        "rule": RULE,
        "ended": last.decision.why,
        "rounds": [_round(settings, r) for r in result.rounds],
        "left": _left(last),
        "refused": result.refused,
        "files": {
            "model": str(result.files.model),
            "predictor": None if result.files.predictor is None else str(result.files.predictor),
            "page": str(settings.out / "loop.html"),
        },
        "undo": applied[-1]["undo"] if applied else None,
        "seconds": {**result.seconds, "total": sum(result.seconds.values())},
    }


def _rows(result: LoopResult) -> list[dict[str, Any]]:
    """A row a run; ``refused``, and the gain against the first run with its interval."""
    first = result.first[0]
    rows = []
    for trial in result.trials:
        gain = compared(first, trial)
        low, high = (1e3 * g for g in gain.gain_ci95_m)
        against = [None, None] if trial is first else [low, high]
        row = {**error_row(trial.name, trial.error), "gain_ci95_mm": against}
        rows.append({**row, "refused": trial.refused})
    return rows


def _round(settings: LoopSettings, r: Round) -> dict[str, Any]:
    folder = settings.path("diagnosis", r.number)
    return {
        "number": r.number,
        "collected": r.collected,
        "verdict": r.report.verdict,
        "found": r.report.summary,
        "effects_found": r.effects_found,
        "changes": [] if r.applied is None else r.applied["changes"],
        "applied": r.applied,
        "gain": None if r.gain is None else r.gain.summary,
        "again": r.decision.again,
        "why": r.decision.why,
        "session": str(settings.path("session", r.number)),
        "diagnosis": str(folder),
        "report": str(Path(folder.name) / "report.html"),
    }


def _left(last: Round) -> str:
    """What the last diagnosis could not explain, in one sentence."""
    structure = last.report.structure_left
    if not structure.flag:
        return "The last diagnosis found no structure in the residual of its session."
    return f"Of the last diagnosis: {structure.text}; no effect of the library explains it."
