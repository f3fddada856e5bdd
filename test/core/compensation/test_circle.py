"""Planned paths on a circle: a planner that wraps angles into -pi..pi turns no arm back."""

import numpy as np
import pytest
from cobot import ALONG, TIMES, arm, follow, through_pi, wrapped

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.circle import check_no_turn, unwrap
from longarm_comp.core.compensation.path import compensate_path
from longarm_comp.core.compensation.planned_path import MotionLimits, PathLimits, PlannedPath
from longarm_comp.core.compensation.result import PathRefused
from longarm_comp.core.model.declared_model import declared_model

SLOW = MotionLimits(np.full(6, 1.0), np.full(6, 3.0))


@pytest.mark.parametrize("limits", [None, SLOW], ids=["free", "limits"])
def test_a_joint_that_may_goes_on_through_pi(limits: MotionLimits | None) -> None:
    model = declared_model(arm(360.0))
    goes, said = through_pi()
    found = follow(model, said, goes[0], limits=PathLimits(limits)).timed
    np.testing.assert_allclose(found.joints, goes, atol=1e-7)
    assert found.times[-1] == pytest.approx(2.0)
    at = np.linspace(0.0, 2.0, 2001)
    assert found.peak_velocity().max() < 0.3
    tips, meant = model.tip(found.at(at)), model.tip(goes)
    nearest = np.linalg.norm(tips[:, None] - meant, axis=2).min(axis=1)
    assert nearest.max() < 1.01 * np.linalg.norm(np.diff(meant, axis=0), axis=1).max() / 2


@pytest.mark.parametrize("limits", [None, SLOW], ids=["free", "limits"])
def test_a_joint_that_may_not_is_refused_at_the_way_point(limits: MotionLimits | None) -> None:
    goes, said = through_pi()
    first = int(np.argmax(goes[:, 0] > np.pi))
    with pytest.raises(PathRefused, match=r"joint1 from .* is a turn back") as refused:
        follow(declared_model(arm(180.0)), said, goes[0], limits=PathLimits(limits))
    assert refused.value.row == first
    assert "outside its limits, -3.142 to 3.142 rad" in str(refused.value)


def test_a_plan_may_begin_a_turn_from_where_the_arm_stands() -> None:
    goes, _ = through_pi()
    stands = goes[0] + [0.8, 0, 0, 0, 0, 0]  # 3.8 rad, which the planner calls -2.48
    plan = wrapped(stands + np.outer(ALONG, [0.3, 0, 0, 0, 0, 0]))
    found = follow(declared_model(arm(360.0)), plan, stands)
    np.testing.assert_allclose(found.timed.joints[[0, -1], 0], [3.8, 4.1], atol=1e-7)
    with pytest.raises(PathRefused, match="way-point 0: bad_target: joint1"):
        follow(declared_model(arm(180.0)), plan, np.clip(stands, -3.1, 3.1))


def test_turns_add_up_either_way_and_end_at_the_limits() -> None:
    wide, goes = arm(720.0), np.linspace(0.0, 12.0, 60)
    joints = np.outer(goes, [1, -1, 0, 0, 0, 0])
    for start in (None, joints[0]):
        np.testing.assert_allclose(unwrap(wide, wrapped(joints), start), joints, atol=1e-9)
    for way in (joints, *(joints[:, :1] * [side, 0, 0, 0, 0, 0] for side in (1, -1))):
        with pytest.raises(PathRefused) as refused:
            unwrap(arm(360.0), wrapped(way), None)
        assert refused.value.row == np.argmax(goes > 2 * np.pi)
    outside = np.zeros((2, 6)) + 3.2  # put inside its limits later: it turns by nothing
    np.testing.assert_array_equal(unwrap(arm(180.0), outside, None), outside)


def test_half_a_turn_is_a_way_and_more_is_none() -> None:
    wide = arm(360.0)
    half = np.array([[0.0] * 6, [np.pi, -np.pi, 0, 0, 0, 0]])
    np.testing.assert_array_equal(unwrap(wide, half, None), half)
    check_no_turn(wide, half)
    more = half * 1.001
    with pytest.raises(PathRefused, match=r"way-point 1: .*joint1 from 0 to 3\.145 rad is more"):
        check_no_turn(wide, more)


def test_what_is_geared_or_slides_is_on_no_circle() -> None:
    half, slide = {"moves": False}, {"type": "prismatic", "limits_deg": None, "limits_m": [0, 9]}
    follows = {"mimic": {"joint": "joint2", "multiplier": 0.5}, "limits_deg": None}
    made = arm(360.0, {2: half, 3: follows, 5: slide})
    assert made.circular.tolist() == [True, False, True, False, True]
    whole = arm(360.0, {2: half, 3: follows | {"mimic": {"joint": "joint2", "multiplier": -2.0}}})
    assert whole.circular.tolist() == [True] * 5
    joints = np.array([np.zeros(5), [0, 6.2, 0, 6.2, 0]])
    np.testing.assert_array_equal(unwrap(made, joints, None), joints)
    check_no_turn(made, joints)


def test_a_path_as_solved_turns_no_joint_farther_than_half_a_turn() -> None:
    """Planned joints lead to the targets, which lie farther apart than they."""
    model = declared_model(arm(180.0))
    solved = np.tile([-1.6, -1.3, 1.4, -1.7, -1.5, 0.2], (2, 1))
    solved[1, 0] = 1.6
    plan = PlannedPath(model.pose(solved), TIMES[:2], solved * [0.95, 1, 1, 1, 1, 1])
    with pytest.raises(PathRefused, match=r"way-point 1: .*from -1\.6 to 1\.6 rad is more than"):
        compensate_path(
            model, None, plan, start=None, history=History.unknown(6),
            context_at=lambda arrived: Context(),
        )  # fmt: skip
