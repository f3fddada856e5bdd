"""Other effects in the place of a part of a finding, or two in the place of one."""

from __future__ import annotations

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


@pytest.fixture(scope="module")
def play_and_droop(demo_arm_path: Path) -> dict[str, Any]:
    return result(demo_arm_path, "backlash", "servo_droop")


def test_a_deadband_that_could_be_play_says_so(play_and_droop: dict[str, Any]) -> None:
    """At the same joints the two are one number; the deadband takes both."""
    assert [names[0] for names in play_and_droop["found"]] == ["servo_droop"]
    assert "deadband: backlash" in play_and_droop["parts"][0]
    assert play_and_droop["covered"]
    assert not play_and_droop["exact"]


def test_what_may_well_be_another_effects_widens_the_interval(demo_arm_path: Path) -> None:
    """Three soft beams fit nearly as well as two and a payload; the third then is far too soft."""
    found = result(demo_arm_path, "link_stiffness", "tip_payload")
    assert found["found"] == [["link_stiffness"]]
    assert "part at beam feed_rail: tip_payload" in found["parts"][0]
    assert len(found["intervals"]) == 3
    assert all(i["low"] <= i["true"] <= i["high"] for i in found["intervals"])
    assert any(i["value"] > 2.0 * i["true"] for i in found["intervals"])


def test_an_effect_that_stands_alone_has_no_parts_of_others(demo_arm_path: Path) -> None:
    gain = result(demo_arm_path, "joint_gain", group="single")
    assert gain["exact"]
    assert gain["parts"] == [[]]
    assert all(i["high"] - i["low"] < 0.1 * abs(i["true"]) + 2e-3 for i in gain["intervals"])


def test_two_effects_take_the_place_of_the_compromise_between_them(demo_arm_path: Path) -> None:
    """Bearings that tilt everywhere do for a payload and a soft base what neither does alone."""
    found = result(demo_arm_path, "tip_payload", "base_compliance")
    assert found["first"][0][0].startswith("bearing_tilt (joint 1, joint 2")
    assert ["tip_payload"] in found["found"]
    assert any("base_compliance" in names for names in found["found"])
    assert not found["flag"]
