"""The study of stated radii: pooled by set, and over the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell

from studies.coverage import LeftOutRows, table


def test_sets_are_pooled_row_by_row() -> None:
    ones = np.ones(3)
    found = [
        LeftOutRows("a", np.array([0.5, 0.9, 2.0]), 0.8 * ones, ones),
        LeftOutRows("b", ones, ones, 2.0 * ones),
        LeftOutRows("a", np.array([1.5]), ones[:1], ones[:1]),
    ]
    first, second = table(found)
    assert (first["set"], first["rows"], first["inside_90"]) == ("a", 4, 0.5)
    assert first["mean_mm"] == pytest.approx(1225.0)
    assert (second["rows"], second["inside_90"], second["p90_mm"]) == (3, 1.0, 2000.0)


def test_the_command_judges_simulated_arms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (row,) = Shell(tmp_path, capsys).json("study", "coverage", "--arms", 1)["rows"]
    assert row["rows"] == 100
    assert 0.8 <= row["inside_90"] <= 0.99
    assert row["mean_mm"] < row["p90_mm"]
