"""`longarm day-report`: a bag of work becomes a page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bag_robot import asked, command, header, robot, sighting, state
from cli_shell import Shell
from small_arm import ARM

from longarm_comp.core.at_work import LEARNED_SAID
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.sessions.day import Day, read_day
from longarm_comp.sessions.message_types import message_types

MISS = 0.5e-3


def said(put: Any, t: float, part: str, level: int, message: str) -> None:
    """A line of /diagnostics."""
    types = message_types().types
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=level, name=f"/kinematics: {part}", message=message, hardware_id="", values=[]
    )
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    put("diagnostics", kind, t, header=header(t), status=[status])


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Four targets in two hours: one is refused, one is not seen."""
    model, rng = declared_model(ARM), np.random.default_rng(0)
    with robot(tmp_path / "today") as put:
        for k, t in enumerate((10.0, 1000.0, 4000.0, 5000.0)):
            q = ARM.lower + rng.random(ARM.n) * (ARM.upper - ARM.lower)
            target = model.tip(q)
            asked(put, t, q, target, "correction of 61 mm is too large" if k == 1 else "")
            if k == 1:
                continue
            command(put, t + 0.1, q.tolist())
            state(put, t + 3.0, q.tolist())
            state(put, t + 5.0, q.tolist())
            if k < 3:
                for s in (3.5, 4.0, 4.5):
                    sighting(put, t + s, (target + (k + 1) * MISS * np.eye(3)[2]).tolist())
            said(put, t + 6.0, LEARNED_SAID, 0, f"learning: friction ({90 + k} %)")
        said(put, 6000.0, "driver", 1, "joint 2 is 61 degC")
        said(put, 6100.0, "driver", 1, "joint 2 is 62 degC")
        said(put, 6200.0, "ready", 0, "ready")
    return tmp_path / "today"


def test_a_day_is_read_from_its_bag(bag: Path) -> None:
    day = read_day(bag, ARM, None, (LEARNED_SAID,))
    assert day.error_mm == pytest.approx([0.5, 1.5, np.nan], nan_ok=True)
    first, second, whole = day.by_hour()
    assert (first["hours"], first["targets"], first["mean_mm"]) == ("0-1 h", 1, pytest.approx(0.5))
    assert (second["targets"], second["seen"]) == (2, 1)
    assert whole["mean_mm"] == pytest.approx(1.0) and whole["max_mm"] == pytest.approx(1.5)
    assert day.refused == {"correction of 61 mm is too large": 1}
    learned, hot = day.said
    assert learned.message == "learning: friction (93 %)"
    assert (learned.first_s, learned.last_s) == pytest.approx((6.0, 4996.0), abs=11.0)
    assert hot.message == "joint 2 is 62 degC" and hot.last_s - hot.first_s == pytest.approx(100.0)


def test_its_page_says_what_was_read(bag: Path, shell: Shell) -> None:
    Path("arm.yaml").write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_none=True)))
    told = shell.json("day-report", "arm.yaml", bag)
    assert told["rows"][-1]["mean_mm"] == pytest.approx(1.0)
    page = Path("day.html").read_text()
    for words in ("3 targets in", "1.00 mm away", "friction (93 %)", "62 degC", "1 target refused"):
        assert words in page
    assert shell("day-report", "arm.yaml", bag) == 0, "its own page may be written again"
    Path("day.html").write_text("mine")
    assert "day.html" in shell.refused("day-report", "arm.yaml", bag)


def test_a_bag_without_targets_is_refused(tmp_path: Path) -> None:
    with robot(tmp_path / "bag") as put:
        command(put, 1.0, ARM.mid.tolist())
        state(put, 3.0, ARM.mid.tolist())
        sighting(put, 4.0, [0.0, 0.0, 0.5])
    with pytest.raises(InputError, match="compensation"):
        read_day(tmp_path / "bag", ARM, None, ())


def test_a_day_on_which_nothing_was_seen_has_a_row() -> None:
    assert Day(1.0, np.zeros(0), np.zeros(0)).by_hour() == [
        {"hours": "all", "targets": 0, "seen": 0, "mean_mm": None, "p95_mm": None, "max_mm": None}
    ]
