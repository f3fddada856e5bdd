"""Pairs of effects that share what they do."""

from pathlib import Path
from typing import Any

import pytest

from longarm_comp.core.arm.arm import Arm
from studies.loop import run_case
from studies.loop_cases import Case


def result(arm_path: Path, *effects: str, group: str = "pair") -> dict[str, Any]:
    case = Case(group, effects, False, "usual", "grid", 300, 1.0, 0, 0)
    made: dict[str, Any] = run_case(case, Arm.load(arm_path))["result"]
    return made


@pytest.mark.long
def test_play_and_a_deadband_at_the_same_joints_are_told_by_their_thresholds(
    demo_arm_path: Path,
) -> None:
    """Which is which no tip tells; it goes where it should."""
    found = result(demo_arm_path, "backlash", "servo_deadband")
    assert [set(names) for names in found["found"]] == 2 * [{"backlash", "servo_deadband"}]
    errors = found["errors_mm"]
    assert errors["with_effects"] < 1.3 * errors["true_effects"] + 0.02


@pytest.mark.long
def test_play_and_servos_that_yield_at_the_same_joints_are_two(demo_arm_path: Path) -> None:
    found = result(demo_arm_path, "backlash", "servo_droop")
    assert {"backlash", "servo_deadband"} in map(set, found["found"])
    assert {"joint_compliance", "servo_droop"} in map(set, found["found"])


@pytest.mark.long
def test_a_payload_that_does_for_soft_beams_too_is_found(demo_arm_path: Path) -> None:
    found = result(demo_arm_path, "link_stiffness", "tip_payload")
    assert found["found"] == [["tip_payload"]]
    assert found["errors_mm"]["with_effects"] < 1.3 * found["errors_mm"]["true_effects"]


@pytest.mark.long
def test_an_effect_that_stands_alone_is_found_with_its_size(demo_arm_path: Path) -> None:
    """At the few levels of this grid an eccentric gear does as well, and the set says so."""
    gain = result(demo_arm_path, "joint_gain", group="single")
    assert gain["covered"]
    assert gain["parts"] == [[]]
    assert all(i["high"] - i["low"] < 0.1 * abs(i["true"]) + 2e-3 for i in gain["intervals"])


@pytest.mark.long
def test_a_payload_and_a_soft_base_are_both_found(demo_arm_path: Path) -> None:
    """Bearings that tilt everywhere would do nearly as well."""
    found = result(demo_arm_path, "tip_payload", "base_compliance")
    assert ["tip_payload"] in found["found"]
    assert any("base_compliance" in names for names in found["found"])
    assert not found["flag"]
