"""The study of stated radii: pooled by set, and over the command."""

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


def held(inside: int, of: int, **more: float) -> LeftOutRows:
    ones = np.ones(of)
    return LeftOutRows("a", np.where(np.arange(of) < inside, 0.5, 2.0), ones, ones, **more)


def verdict(*rows: LeftOutRows) -> str:
    (row,) = table(list(rows))
    return str(row["kept"])


def test_it_is_said_where_the_radius_cannot_be_told() -> None:
    """Ninety of a hundred hold; too many do not either; a few rows tell nothing."""
    assert verdict(held(90, 100)) == "yes"
    assert verdict(held(990, 1000)) == "no"
    assert verdict(held(800, 1000)) == "no"
    assert verdict(held(17, 20)) == "too few rows to tell"
    beside = verdict(held(15, 20, apart=2.5))
    assert beside == "no; they lie off as a whole (2.5 sigma): another day or set-up"
    assert "fitted at 2 places, 90 % takes 9" in verdict(held(50, 60, places=2))
    assert "40% are far from the fitted rows" in verdict(held(50, 100, inside_data=0.6))


def test_places_that_differ_count_as_few_rows() -> None:
    alike = table([held(85, 100) for _ in range(8)])[0]
    uneven = table([held(70 + 30 * (k % 2), 100) for k in range(8)])[0]
    assert alike["inside_90"] == uneven["inside_90"] == 0.85
    width = [np.ptp(row["ci95"]) for row in (alike, uneven)]
    assert width[1] > 3.0 * width[0]
    assert (alike["kept"], uneven["kept"]) == ("no", "too few rows to tell")


def test_the_command_judges_simulated_arms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row, tip = Shell(tmp_path, capsys).json("study", "coverage", "--no-pandas", "--arms", 1)["rows"]
    assert row["rows"] == 100
    assert 0.8 <= row["inside_90"] <= 0.99
    assert row["mean_mm"] < row["p90_mm"]
    assert tip["rows"] == 100 and tip["set"].startswith("the tip alone")
    assert tip["mean_mm"] < row["mean_mm"] and tip["expected_mm"] < row["expected_mm"]
