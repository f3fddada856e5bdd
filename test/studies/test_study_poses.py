"""The study of poses: what it measures, and its table."""

import json
from collections.abc import Iterator

import numpy as np
import pytest
from click.testing import CliRunner

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.planning.optimal_poses import OptimalPlan
from studies import poses
from studies.poses import command


@pytest.mark.long
def test_the_error_is_that_of_the_true_arm_and_falls_with_the_poses(demo: Arm) -> None:
    found = list(poses.one_arm(demo, 0, counts=(25, 150), ways=("sobol",)))
    assert [(o.n, o.known) for o in found] == [(25, True), (25, False), (150, True), (150, False)]
    few, _, many, searched = (o.error for o in found)
    assert many < 0.7 * few < 1e-3
    assert searched < 1.5 * many
    worst = poses.one_arm(demo, 0, counts=(25,), ways=("grid",))
    assert next(worst).way == "grid"


def test_i_optimal_poses_are_of_what_is_known(demo: Arm) -> None:
    plan = poses.plan_poses(demo, "i-optimal", 25, True, 0)
    assert isinstance(plan, OptimalPlan) and len(plan) == 25
    assert 1e-4 < plan.expected_m < 5e-4


def test_the_command_prints_a_row_a_count_and_knowledge(monkeypatch: pytest.MonkeyPatch) -> None:
    def lived(arm: Arm, seed: int) -> Iterator[poses.PoseOutcome]:
        for known in (True, False):
            for way in poses.WAYS:
                yield poses.PoseOutcome(way, 40, known, 1e-3 * (seed + known), np.nan)

    monkeypatch.setattr(poses, "one_arm", lived)
    done = CliRunner().invoke(command, ["--arms", "2", "--seed", "3", "--json"])
    assert done.exit_code == 0, done.output
    rows = json.loads(done.stdout)["rows"]
    assert [(r["effect"], r["poses"]) for r in rows] == [("known", 40), ("to be found", 40)]
    assert rows[0]["i-optimal_mm"] == pytest.approx(4.5)
    assert rows[1]["grid_mm"] == pytest.approx(3.5)
    shown = CliRunner().invoke(command, ["--arms", "1"])
    assert "to be found" in shown.stdout
