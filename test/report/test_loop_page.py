"""The page of a loop says what of each round the user must know."""

from typing import Any

import numpy as np
import pytest

from longarm_comp.report.pages import loop_page

ROUND: dict[str, Any] = {
    "number": 1,
    "found": "joint_gain explains it.",
    "verdict": "named",
    "collected": 60,
    "report": "diagnosis/report.html",
    "applied": None,
    "again": False,
    "why": "not applied: there was no answer yes",
    "session": "session",
    "diagnosis": "diagnosis",
}


@pytest.mark.parametrize(
    "not_driven", [{}, {"no way there: wall": 4, "asked for in a keep-out box": 2}]
)
def test_the_loops_page_names_the_poses_that_were_not_driven(not_driven: dict[str, int]) -> None:
    errors = {"not compensated": np.full((3, 3), 2e-3), "before": np.full((3, 3), 1e-3)}
    row = dict.fromkeys(("mean_mm", "rms_mm", "p95_mm", "max_mm", "mean_abs_z_mm"), 1.0)
    data = {
        "arm": "boom",
        "rows": [{"run": name, "n": 3, "gain_ci95_mm": (None, None)} | row for name in errors],
        "helps": False,
        "summary": "compensation does not help beyond chance",
        "rule": "a rule",
        "ended": ROUND["why"],
        "rounds": [ROUND | {"not_driven": not_driven}],
        "left": "Nothing.",
        "refused": [],
        "files": {"model": "model.yaml", "predictor": None},
        "undo": None,
    }
    page = loop_page(data, errors)
    assert ("Poses that were not driven" in page) == bool(not_driven)
    for why, count in not_driven.items():
        assert f"<li>{count}: {why}</li>" in page
