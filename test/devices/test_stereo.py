"""Stereo measurement against rendered images whose truth is known."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from stereo_head import HEAD, PLATE, TAG, eye_for, marker_pose, pair

from longarm_comp.devices.stereo.eye import StereoEye
from longarm_comp.devices.stereo.found import Limits
from longarm_comp.devices.stereo.target import CharucoTarget, TagBoard
from longarm_comp.sim import cameras
from longarm_comp.sim.cameras import Plate, charuco_plate, render, tag_plate


@pytest.mark.parametrize(
    ("plate", "target"),
    [
        (tag_plate(0.06), TagBoard(0.06)),
        (tag_plate(0.04, 0.01, 2, 2), TagBoard(0.04, 0.01, 2, 2)),
        (
            tag_plate(0.08, dictionary="DICT_APRILTAG_36h11", first_id=7),
            TagBoard(0.08, dictionary="DICT_APRILTAG_36h11", first_id=7),
        ),
    ],
    ids=["tag", "grid", "apriltag"],
)
def test_error_is_small_unbiased_and_inside_its_covariance(plate: Any, target: Any) -> None:
    """1.2 m away: no bias beyond 3 standard errors + 0.02 mm, and chi-square of the right size."""
    rng = np.random.default_rng(11)
    eye = eye_for(target=target)
    for _ in range(10):  # until the corners have told how well they are located
        eye.measure(*render(marker_pose(HEAD, 1.2, rng), plate, HEAD, rng))
    errors, normalised = [], []
    for _ in range(30):
        truth = marker_pose(HEAD, 1.2, rng)
        seen = eye.measure(*render(truth, plate, HEAD, rng))
        error = seen.point - truth[:3, 3]
        errors.append(HEAD.camera_in_base[:3, :3].T @ error)
        normalised.append(error @ np.linalg.solve(seen.pose_covariance[:3, :3], error))
    sd = np.std(errors, axis=0, ddof=1)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 3 * sd / np.sqrt(30) + 2e-5)
    assert np.all(sd < [5e-5, 5e-5, 2e-4])
    # Neighbouring corners share a side, so their errors are not independent: sigma within a
    # factor of two of the truth, and no more outliers than a chi-square has.
    assert 3 / 4 < np.mean(normalised) < 3 * 4
    assert np.mean(np.array(normalised) < stats.chi2.ppf(0.95, 3)) > 0.75
    assert 0.005 < eye.expected_noise.sigma_px < 0.03


def test_error_grows_with_the_square_of_depth_and_sigma_says_so() -> None:
    """Depth sigma ~ z^2 / (f B): three times as far is nine times as uncertain, and worse."""
    rng = np.random.default_rng(2)
    eye = eye_for()
    near, far = (eye.measure(*render(marker_pose(HEAD, z), PLATE, HEAD, rng)) for z in (0.8, 2.4))
    turn = HEAD.camera_in_base[:3, :3]
    near, far = (np.diag(turn.T @ seen.pose_covariance[:3, :3] @ turn) for seen in (near, far))
    assert 6 < np.sqrt(far[2] / near[2]) < 30
    assert far[2] > far[0]


def test_charuco_board_is_measured_by_the_same_code() -> None:
    rng = np.random.default_rng(4)
    eye = eye_for(target=CharucoTarget(0.04, 0.03, 5, 5))
    truth = marker_pose(HEAD, 1.0, rng)
    seen = eye.measure(*render(truth, charuco_plate(0.04, 0.03, 5, 5), HEAD, rng))
    assert seen.corners >= 9
    assert np.linalg.norm(seen.point - truth[:3, 3]) < 2e-4


def test_distorted_turned_raw_cameras_agree_with_the_truth() -> None:
    """K, D, R and P of raw images: a strongly distorted lens, the right camera turned by 3 deg."""
    head = dataclasses.replace(
        HEAD, d=(-0.25, 0.08, 0.001, -0.0007, 0.0), right_turn_rad=(0.02, -0.04, 0.01)
    )
    eye = eye_for(head)
    rng = np.random.default_rng(5)
    for _ in range(4):
        truth = marker_pose(head, 1.3, rng)
        seen = eye.measure(*render(truth, PLATE, head, rng))
        error = np.linalg.inv(head.camera_in_base)[:3, :3] @ (seen.point - truth[:3, 3])
        assert np.all(np.abs(error) < [1e-4, 1e-4, 5e-4])
        assert np.abs(seen.pose[:3, :3] - truth[:3, :3]).max() < 0.02


def test_rectified_and_raw_give_the_same_where_there_is_no_distortion() -> None:
    left, right = pair()
    raw, rectified = (eye_for(rectified=r).measure(left, right) for r in (False, True))
    np.testing.assert_allclose(raw.point, rectified.point, atol=1e-9)


def test_tip_away_from_the_marker_with_the_covariance_of_the_lever() -> None:
    left, right = pair()
    tip = np.array([0.02, -0.1, 0.03])
    centre, offset = (
        eye_for().measure(left, right),
        eye_for(tip_in_marker=tip).measure(left, right),
    )
    np.testing.assert_allclose(offset.point, (centre.pose @ [*tip, 1.0])[:3], atol=1e-12)
    assert np.trace(offset.pose_covariance[:3, :3]) > np.trace(centre.pose_covariance[:3, :3])
    rig = eye_for().rig
    bare = StereoEye(rig, TAG, tip_in_marker=tip).measure(left, right)
    turns = np.kron(np.eye(2), HEAD.camera_in_base[:3, :3])
    np.testing.assert_allclose(
        offset.pose_covariance, turns @ bare.pose_covariance @ turns.T, atol=1e-15
    )


def test_a_print_of_the_wrong_size_moves_the_scale_not_the_point() -> None:
    """1 % too large: pure size-from-perspective would be 12 mm off at 1.2 m."""
    rng = np.random.default_rng(8)
    truth = marker_pose(HEAD, 1.2, rng)
    plate = tag_plate(0.06)
    large = render(truth, Plate(plate.texture, (1.01 * plate.size_m[0],) * 2), HEAD, rng)
    seen = eye_for(limits=Limits(size_tolerance=0.02)).measure(*large)
    assert seen.scale == pytest.approx(1.01, abs=0.002)
    assert np.linalg.norm(seen.point - truth[:3, 3]) < 3e-4


def test_the_cameras_share_nothing_with_the_measurement() -> None:
    """Or an error of convention would cancel in every test above."""
    assert cameras.__file__ is not None
    assert "longarm_comp.devices.stereo" not in Path(cameras.__file__).read_text("utf-8")
