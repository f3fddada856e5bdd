"""The study of realisable commands: its figures are the ones that were promised."""

import json
from typing import Any

import pytest
from click.testing import CliRunner

from studies.realisable import command

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def study() -> dict[str, Any]:
    """What ``longarm study realisable --json`` prints, on fewer targets than by default."""
    done = CliRunner().invoke(command, ["--targets", "14", "--json"])
    assert done.exit_code == 0, done.output
    printed: dict[str, Any] = json.loads(done.stdout)
    return printed


def test_arms(study: dict[str, Any]) -> None:
    rows = {(r["arm"], r["target"]): r for r in study["arms"]}
    assert all(r["targets"] == 14 for r in rows.values())
    assert all(r["rounded_mm"] > 2 for r in rows.values())
    assert rows["5 joints", "position"]["mean_mm"] < 0.5
    assert rows["7 joints", "position"]["mean_mm"] < 0.12
    assert rows["9 joints", "position"]["mean_mm"] < 0.08
    assert rows["7 joints", "pose"]["mean_mm"] < 1.0
    assert rows["7 joints", "pose"]["mean_mrad"] < rows["7 joints", "pose"]["rounded_mrad"]
    assert rows["7 joints", "position"]["mean_mrad"] is None


def test_a_lower_price_is_nearer_and_moves_further(study: dict[str, Any]) -> None:
    ideal, rounding, *rows = study["price"]
    assert [r["price_mm_per_deg"] for r in rows] == sorted(
        (r["price_mm_per_deg"] for r in rows), reverse=True
    )
    errors = [r["mean_mm"] for r in rows]
    assert errors == sorted(errors, reverse=True) and errors[0] < rounding["mean_mm"]
    moves = [r["moved_deg"] for r in rows]
    assert ideal["moved_deg"] == 0 < rounding["moved_deg"] < moves[0]
    assert moves == sorted(moves)
    assert ideal["path_move_deg"] < rounding["path_move_deg"] < rows[0]["path_move_deg"]


def test_what_the_choice_must_know(study: dict[str, Any]) -> None:
    rows = {r["truth"]: r for r in study["sensitivity"]}
    right = rows["as declared"]
    assert right["mean_mm"] == pytest.approx(
        next(r for r in study["price"] if r["price_mm_per_deg"] == 0.1)["mean_mm"], abs=1e-3
    )
    assert right["mean_mm"] < 0.05 * right["rounded_mm"]
    aside = rows["tip 0.2 mm aside"]["mean_mm"]
    assert aside == pytest.approx(0.2, abs=right["mean_mm"])
    offsets = [rows[f"offset of up to {s:g} of a step"]["mean_mm"] for s in (0.1, 0.25, 0.5)]
    assert right["mean_mm"] < offsets[0] < offsets[1] < offsets[2]
    known = rows["offset of sd 0.15 of a step"]
    assert known["mean_mm"] < 0.8 * known["rounded_mm"]
    assert rows["500 steps a turn"]["mean_mm"] > rows["500 steps a turn"]["rounded_mm"]
