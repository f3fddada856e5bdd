"""What `longarm check` says of an arm.yaml alone: how the arm stands, its beams, its range."""

import re
from pathlib import Path

import numpy as np
import pytest

from longarm_comp.arm_folder.check import check_folder
from longarm_comp.arm_folder.make import demonstration
from longarm_comp.arm_folder.parameter_file import parameters_of


def box(width: float = 0.02, height: float = 0.04) -> str:
    return f"""
name: boom
convention: mdh_craig
tip: {{frame: 3}}
joints:
  - {{id: 1, type: revolute, limits_deg: [-60, 60]}}
  - {{id: 2, type: revolute, alpha_deg: 90, limits_deg: [-5, 50]}}
  - {{id: 3, type: revolute, a_m: 1.0, limits_deg: [-1, 1]}}
links:
  - {{name: box, row: 3, role: a, length_m: 1.0, E_pa: 7.0e+10, poisson: 0.33, mass_kg: 1.5,
     body_length_m: 1.0, section: {{type: rect, width_m: {width}, height_m: {height}}}}}
point_masses: [{{name: tool, frame: 3, mass_kg: 2.0}}]
"""


@pytest.mark.parametrize(
    ("base", "gravity", "level", "words"),
    [
        ("[0, 0, 0]", "[0, 0, -9.81]", "declared", "stands on its base: .* leans 0 deg"),
        ("[0, 0, 0]", "[0, 0, 9.81]", "unmeasured", "hangs down .* level base.*turns round"),
        ("[180, 0, 0]", "[0, 0, -9.81]", "declared", "hangs down from its base: .* 180 deg"),
        ("[0, 90, 0]", "[0, 0, -9.81]", "declared", "reaches out from its base: .* 90 deg"),
        ("[0, 0, 0]", "[0, 0, 0]", "implausible", "no gravity"),
    ],
)
def test_check_says_how_the_arm_stands(
    base: str, gravity: str, level: str, words: str, tmp_path: Path
) -> None:
    text = f"{box()}base: {{rpy_deg: {base}}}\ngravity_mps2: {gravity}\n"
    (tmp_path / "arm.yaml").write_text(text)
    (found,) = [f for f in check_folder(tmp_path) if "gravity_mps2" in f.where]
    assert found.level == level and re.search(words, found.text)


@pytest.mark.parametrize(("width", "height"), [(0.02, 0.04), (0.04, 0.02)])
def test_check_says_how_beams_stand_and_prints_the_sag(
    width: float, height: float, tmp_path: Path
) -> None:
    """A clamped beam by the textbook. Its height is along the level axis of joint 2."""
    (tmp_path / "arm.yaml").write_text(box(width, height))
    beam, sag, ring, _ = (f.text for f in check_folder(tmp_path) if f.level == "declared")
    expected = 9.80665 * (2.0 / 3 + 1.5 / 8) / (7e10 * height * width**3 / 12)
    found = re.search(r"sags by ([\d.]+) mm", sag)
    assert found is not None and float(found[1]) == pytest.approx(1e3 * expected, rel=0.02)
    assert "held out to 1.00 m" in sag
    stiffness = 3 * 7e10 * height * width**3 / 12  # of the upright side, and 33/140 of the beam
    other = 3 * 7e10 * width * height**3 / 12
    hz = np.sqrt(min(stiffness, other) / (2.0 + 33 / 140 * 1.5)) / (2 * np.pi)
    told = re.search(r"rings at ([\d.]+) Hz; how long: longarm modes", ring)
    assert told is not None and float(told[1]) == pytest.approx(hz, rel=0.03)
    assert "width_m is upright there, to 0 deg" in beam


@pytest.mark.parametrize(
    ("joint", "ends"),
    [
        ("endless: true, limits_deg: [-900, 900]", []),
        ("limits_deg: [-720, 720]", []),
        ("limits_deg: [-721, 0]", ["joints.joint1"]),
    ],
)
def test_a_joint_with_ends_turns_twice_at_most(joint: str, ends: list[str], tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text(box().replace("limits_deg: [-60, 60]", joint))
    assert [f.where for f in check_folder(tmp_path) if f.level == "implausible"] == [
        f"arm.yaml: {name}.limits_deg" for name in ends
    ]


def test_parameters_that_ros_gives_every_node_are_no_strangers(tmp_path: Path) -> None:
    section = "  ros__parameters:\n"
    for name, text in demonstration().items():
        (tmp_path / name).write_text(text.replace(section, f"{section}    use_sim_time: true\n"))
    assert not [finding for finding in check_folder(tmp_path) if finding.blocks]
    assert parameters_of("stereo_bridge", tmp_path / "stereo_bridge.yaml")["use_sim_time"] is True
