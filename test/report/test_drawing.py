"""What is drawn: arrows and scene of the report."""

import json

import numpy as np
import pytest
from report_samples import named

from longarm_comp.report.detail import SeenRows
from longarm_comp.report.plots import MOST, exaggeration, scene_json
from longarm_comp.report.style import LOOKS

# Arrows and scene


def test_few_arrows_of_many_rows(rng: np.random.Generator) -> None:
    n = 5000
    rows = SeenRows(np.arange(n), rng.random((n, 3)), {"nominal": 1e-3 * rng.normal(size=(n, 3))})
    found = json.loads(scene_json(rows))["rows"]
    assert len(found) == MOST and found[0] == 0 and found[-1] == n - 1


def test_errors_of_zero_have_arrows_of_no_length() -> None:
    rows = SeenRows(np.arange(3), np.eye(3), {"nominal": np.zeros((3, 3))})
    assert exaggeration(rows, "nominal") == 1.0
    stage = json.loads(scene_json(rows))["stages"]["nominal"]
    assert stage["times"] == 1.0 and stage["errors"] == np.zeros((3, 3)).tolist()


def test_a_session_without_held_out_positions_has_an_empty_scene() -> None:
    none = np.zeros((0, 3))
    scene = json.loads(scene_json(SeenRows(np.zeros(0, int), none, {"nominal": none})))
    assert (scene["rows"], scene["stages"]["nominal"]["times"]) == ([], 1.0)


def test_scene_has_every_stage_at_its_own_scale(rng: np.random.Generator) -> None:
    rows = named(rng)[1].held_out
    assert rows is not None
    scene = json.loads(scene_json(rows))
    assert [np.array(arm) == pytest.approx(line, abs=1e-5) for arm, line in
            zip(scene["arms"], rows.arms_m, strict=True)] == [True] * len(rows.arms_m)  # fmt: skip
    assert scene["rows"] == rows.index.tolist()
    assert np.array(scene["tips"]) == pytest.approx(rows.measured_m, abs=1e-5)
    assert list(scene["stages"]) == list(rows.errors_m)
    for name, stage in scene["stages"].items():
        times = stage["times"]
        assert times == exaggeration(rows, name) and float(f"{times:.0e}"[0]) in {1, 2, 5}
        assert np.array(stage["errors"]) == pytest.approx(rows.errors_m[name], abs=1e-5)
        assert stage["color"] == LOOKS[name].color
