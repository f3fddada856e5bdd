"""The study of planned paths: curves, play, deviations, and the command with its file."""

from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell
from places import DEMO_ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.model import Model
from longarm_comp.math.cubic_path import CubicPath
from longarm_comp.sim.arm_truth import TrueArm
from studies import path

ARM = Arm.load(DEMO_ARM)


def test_an_arc_runs_through_three_points_on_one_circle() -> None:
    a, b, c = np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 1.0]), np.array([2.0, 0.0, 1.0])
    arc = path.through(a, b, c, np.linspace(0.0, 1.0, 101))
    np.testing.assert_allclose(arc[[0, 50, 100]], [a, b, c], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(arc - [1.0, 0.0, 1.0], axis=1), 1.0)
    shallow = path.through(a, np.array([1.0, 0.2, 1.0]), c, np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(shallow, [a, [1.0, 0.2, 1.0], c], atol=1e-12)
    line = path.through(a, 0.5 * (a + c), c, np.array([0.25]))
    np.testing.assert_allclose(line, [[0.5, 0.0, 1.0]])


def test_a_joint_with_play_stands_still_until_its_play_is_taken_up() -> None:
    q = np.array([[0.0], [1.0], [0.9], [0.5], [0.6]])
    stands = q - path.lagging(q, np.array([0.2]), np.array([0.2]))
    np.testing.assert_allclose(stands[:, 0], [-0.2, 0.8, 0.8, 0.7, 0.7])


def test_a_deviation_is_the_distance_from_the_curve_and_not_from_its_timing() -> None:
    stiff = ARM.model_copy(update={"links": (), "point_masses": (), "payload": None})
    studied = path.StudiedArm(stiff, TrueArm(stiff, [path.Play()]), np.zeros(7), Model(stiff))
    found = path.way(stiff, "joints", 0.1, np.random.default_rng(1))
    assert found.plan.times is not None and found.plan.joints is not None
    zero = np.zeros_like(found.plan.joints)
    on_the_way = CubicPath(found.plan.times**1.5, found.plan.joints, zero)
    assert path.deviation(studied, on_the_way, found.curve, np.ones(7)).max() < 1e-7
    beside = np.array([0.0, 0.0, 3e-3])
    off = path.deviation(studied, on_the_way, found.curve + beside, np.ones(7))
    assert off.max() <= 3e-3 + 1e-7 and off[0] == pytest.approx(3e-3, rel=0.3)


def test_the_command_leaves_a_tenth_and_continues_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(path, "SPEEDS", (0.5,))
    monkeypatch.setattr(path, "KINDS", ("line",))
    shell, file = Shell(tmp_path, capsys), tmp_path / "path.jsonl"
    words = ("study", "path", "--paths", 1, "-o", file)
    (row,) = shell.json(*words, "--arms", 1)["rows"]
    assert row["after_rms_mm"] < 0.1 * row["before_rms_mm"]
    assert row["after_max_mm"] < 0.1 * row["before_max_mm"]
    assert row["jerk_ratio"] < 1.1 and row["ms_per_waypoint"] > 0.0
    held = file.read_text()
    monkeypatch.setattr(path, "one_arm", None)  # nothing is left to run
    assert shell.json(*words, "--arms", 1)["rows"] == [row]
    assert file.read_text() == held
