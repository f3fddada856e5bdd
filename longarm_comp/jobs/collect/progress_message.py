"""`Progress` as the message on ``collect/progress``."""

from __future__ import annotations

import math

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from longarm_comp.jobs.collect.progress import Progress

_LEVELS = {"ended": DiagnosticStatus.ERROR, "paused": DiagnosticStatus.WARN,
           "waiting": DiagnosticStatus.WARN}  # fmt: skip


def progress_message(now: Progress, namespace: str) -> DiagnosticStatus:
    """Name ``collect``; what is not known yet has no value (docs/ros.md)."""
    losing = DiagnosticStatus.WARN if now.lost else DiagnosticStatus.OK
    numbers = {"error_mm": now.error_mm, "eta_s": now.seconds_left}
    values = {
        "state": now.state, "done": now.done, "total": now.total, "seen": now.seen,
        "lost": len(now.lost), "pose": now.visit,
        **{name: f"{value:.3f}" for name, value in numbers.items() if math.isfinite(value)},
    }  # fmt: skip
    return DiagnosticStatus(
        level=_LEVELS.get(now.state, losing),
        name="collect",
        message=str(now),
        hardware_id=namespace,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )
