"""The mathematics under the stereo measurement, hand-eye, and calibration from pictures."""

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest
from stereo_head import HEAD, PLATE, TAG, marker_pose

from longarm_comp.core.errors import JobError
from longarm_comp.devices.stereo.calibrate import calibrate_stereo, hand_eye
from longarm_comp.devices.stereo.camera import Camera, StereoRig
from longarm_comp.devices.stereo.eye import StereoEye
from longarm_comp.devices.stereo.target import CharucoTarget
from longarm_comp.devices.stereo.triangulate import triangulate
from longarm_comp.sim.cameras import charuco_plate, render

# ---- mathematics --------------------------------------------------------------------------------


def test_projection_and_jacobian_against_opencv_and_differences() -> None:
    rng = np.random.default_rng(6)
    d = (0.2, -0.1, 0.002, -0.001, 0.03, 0.1, 0.02, -0.01)
    turn = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0]
    camera = Camera(
        [[700, 0.0, 300], [0, 710, 250], [0, 0, 1]], turn, [0.1, 0, 0.02], (640, 480), d
    )
    points = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 2.0], (20, 3))
    pixels, jacobian = camera.project(points)
    known = cv2.projectPoints(points, turn, camera.translation, camera.k, camera.d)[0]
    np.testing.assert_allclose(pixels, known.reshape(-1, 2), atol=1e-9)
    step = 1e-6
    for axis in range(3):
        moved = np.eye(3)[axis] * step
        slope = (camera.project(points + moved)[0] - camera.project(points - moved)[0]) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, axis], slope, rtol=1e-5, atol=1e-4)


def test_triangulation_is_exact_also_through_distorted_and_turned_cameras() -> None:
    head = dataclasses.replace(
        HEAD, d=(-0.2, 0.05, 0.0, 0.0, 0.0), right_turn_rad=(0.0, -0.03, 0.0)
    )
    rig = StereoRig.from_camera_info(*head.camera_infos(), rectified=False)
    points = np.array([[0.1, -0.05, 1.5], [-0.2, 0.1, 0.8], [0.3, 0.2, 2.5]])
    left, right = rig.left.project(points)[0], rig.right.project(points)[0]
    exact, rms_px = triangulate(rig, left, right)
    np.testing.assert_allclose(exact, points, atol=1e-9)
    assert rms_px < 1e-6


# ---- hand-eye -----------------------------------------------------------------------------------

CAMERA = HEAD.camera_in_base
SIGMA_M = np.array([1e-4, 1e-4, 5e-4])


def session(rng: np.random.Generator, count: int = 25) -> Any:
    """Tips (N, 3) m all over the workspace, seen with noise, and its covariance."""
    tips = rng.uniform([0.4, -0.3, 0.1], [1.1, 0.3, 0.7], (count, 3))
    seen = (tips - CAMERA[:3, 3]) @ CAMERA[:3, :3] + rng.normal(0.0, SIGMA_M, (count, 3))
    return tips, seen, np.broadcast_to(np.diag(SIGMA_M**2), (count, 3, 3))


def test_hand_eye_finds_the_camera_with_an_honest_covariance() -> None:
    rng = np.random.default_rng(12)
    normalised = []
    for _ in range(40):
        fit = hand_eye(*session(rng))
        turn = cv2.Rodrigues(fit.camera_in_base[:3, :3] @ CAMERA[:3, :3].T)[0].ravel()
        error = np.concatenate([fit.camera_in_base[:3, 3] - CAMERA[:3, 3], turn])
        normalised.append(error @ np.linalg.solve(fit.covariance, error) / len(error))
        assert not fit.outliers
    assert 0.75 < np.mean(normalised) < 1.25


def test_hand_eye_leaves_an_outlier_out_and_refuses_what_it_cannot_tell() -> None:
    rng = np.random.default_rng(13)
    tips, seen, covariances = session(rng)
    seen[7] += [0.0, 0.05, 0.0]
    fit = hand_eye(tips, seen, covariances)
    assert fit.outliers == (7,)
    assert fit.rms_m < 1e-3 and np.linalg.norm(fit.residuals[7]) > 0.04
    line = np.linspace([0.4, 0.0, 0.2], [0.9, 0.1, 0.4], len(tips))
    with pytest.raises(JobError, match="reach over more"):
        hand_eye(line, (line - CAMERA[:3, 3]) @ CAMERA[:3, :3], covariances)


# ---- calibration --------------------------------------------------------------------------------


def test_a_rendered_calibration_session_gives_the_cameras_back() -> None:
    """Distorted lenses, a ChArUco board partly out of view: focal, baseline and a held-out tag."""
    rng = np.random.default_rng(14)
    head = dataclasses.replace(HEAD, d=(-0.15, 0.05, 0.0, 0.0, 0.0))
    board, plate = CharucoTarget(0.04, 0.028, 7, 5), charuco_plate(0.04, 0.028, 7, 5)
    pairs = []
    for _ in range(7):
        pose = marker_pose(head, rng.uniform(0.7, 1.1), rng)
        left, right = render(pose, plate, head, rng)
        pairs.append((board.detect(left), board.detect(right)))
    found = calibrate_stereo(board, pairs, head.size)
    assert found.rms_px < 0.05
    assert found.rig.left.k[0, 0] == pytest.approx(head.focal_px, rel=0.003)
    assert found.rig.baseline_m == pytest.approx(head.baseline_m, rel=0.003)
    truth = marker_pose(head, 1.0, rng)
    eye = StereoEye(found.rig, TAG, head.left_in_base)
    seen = eye.measure(*render(truth, PLATE, head, rng))
    assert np.linalg.norm(seen.point - truth[:3, 3]) < 3e-3
