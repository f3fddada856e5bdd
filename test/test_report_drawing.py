"""What is drawn: arrows and scene of the report."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from report_samples import named

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.modes import modes
from longarm_comp.core.vibration.ring import ring_of_moves
from longarm_comp.report.detail import SeenRows, rings
from longarm_comp.report.plots import MOST, exaggeration, scene_json
from longarm_comp.report.style import LOOKS
from longarm_comp.report.write import write_report

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


def test_the_page_says_how_the_arm_rings(
    rng: np.random.Generator, demo_arm_path: Path, tmp_path: Path
) -> None:
    arm = Arm.load(demo_arm_path).model_copy(update={"damping": 0.02})
    soft = declared_model(arm).plus(JointCompliance(joint=2, compliance=5e-3))
    told = rings(soft)
    assert told is not None and "0.02 (arm.yaml)" in told.caption
    ends = np.array([arm.lower, arm.mid, arm.upper])
    for q, line, (found, left) in zip(
        ends, told.rows, ring_of_moves(soft, ends, 0.5, 0.02), strict=True
    ):
        assert line[1:] == (modes(declared_model(arm), q).hz[0], found.hz[0], left.settle_s())
        assert found.hz[0] < line[1]  # it is softer than declared
    assert rings(Model(arm)) is None
    record, page = named(rng)
    write_report(record, dataclasses.replace(page, rings=told), tmp_path)
    text = (tmp_path / "report.html").read_text()
    row = text[text.index(">middle<") :].partition("</tr>")[0]
    assert [float(x) for x in re.findall(r">([0-9.]+)</td>", row)] == pytest.approx(
        told.rows[1][1:], rel=0.01
    )
    assert "How the arm rings" in text and "0.02 (arm.yaml)" in text
    write_report(record, page, tmp_path / "rigid")
    assert "How the arm rings" not in (tmp_path / "rigid" / "report.html").read_text()
