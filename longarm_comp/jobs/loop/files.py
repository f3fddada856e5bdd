"""Files that a loop ends with: loop.json and its page."""

from __future__ import annotations

import json
from typing import Any

from longarm_comp.core.files import write_text
from longarm_comp.jobs.loop.run import LoopResult
from longarm_comp.jobs.loop.settings import LoopSettings
from longarm_comp.jobs.loop.summary import summary
from longarm_comp.report.loop_page import loop_page


def write_loop(arm: str, settings: LoopSettings, result: LoopResult) -> dict[str, Any]:
    """Write ``loop.json`` and ``loop.html``; the contents of the former."""
    data = summary(arm, settings, result)
    write_text(settings.out / "loop.json", json.dumps(data, indent=2))
    write_text(
        settings.out / "loop.html", loop_page(data, {t.name: t.error for t in result.trials})
    )
    return data
