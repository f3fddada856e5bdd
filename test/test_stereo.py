"""Stereo measurement against rendered images whose truth is known."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy import stats

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.stereo import (
    Camera,
    CharucoTarget,
    Chessboard,
    Drop,
    Limits,
    PixelNoise,
    Reason,
    Side,
    StereoEye,
    StereoPairer,
    StereoRefusal,
    StereoRig,
    TagBoard,
    calibrate_stereo,
    fit_rigid,
    hand_eye,
    triangulate,
)
from longarm_comp.sim import cameras, plates
from longarm_comp.sim.cameras import CameraPair, Conditions, render
from longarm_comp.sim.plates import charuco_plate, tag_plate

HEAD = CameraPair()
TAG = TagBoard(0.06)
PLATE = tag_plate(0.06)


def marker_pose(
    head: CameraPair, depth: float, rng: np.random.Generator | None = None
) -> np.ndarray:
    """A marker facing the cameras, in both views; turned and moved at random if `rng` is given."""
    camera_T_marker = np.eye(4)
    camera_T_marker[:3, :3] = np.diag([1.0, -1.0, -1.0])
    camera_T_marker[:3, 3] = [head.baseline_m / 2, 0.0, depth]
    if rng is not None:
        turn = cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0]
        camera_T_marker[:3, :3] = camera_T_marker[:3, :3] @ turn
        left = head.baseline_m / depth - 0.33
        camera_T_marker[0, 3] = depth * rng.uniform(max(left, -0.33), 0.33)
        camera_T_marker[1, 3] = depth * rng.uniform(-0.2, 0.2)
    return head.left_in_base @ camera_T_marker


def eye_for(
    head: CameraPair = HEAD, target: Any = TAG, rectified: bool = False, **options: Any
) -> StereoEye:
    rig = StereoRig.from_camera_info(*head.camera_infos(), rectified=rectified)
    return StereoEye(rig, target, head.camera_in_base, **options)


def pair(
    conditions: Conditions | None = None, plate: Any = PLATE, depth: float = 1.2
) -> tuple[Any, Any]:
    return render(marker_pose(HEAD, depth), plate, HEAD, np.random.default_rng(3), conditions)


# ---- accuracy -----------------------------------------------------------------------------------


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
        eye.measure(*render(marker_pose(HEAD, 1.2, rng), plate, HEAD, rng), 0)
    errors, normalised = [], []
    for _ in range(30):
        truth = marker_pose(HEAD, 1.2, rng)
        seen = eye.measure(*render(truth, plate, HEAD, rng), 0)
        error = seen.point - truth[:3, 3]
        errors.append(HEAD.camera_in_base[:3, :3].T @ error)
        normalised.append(error @ np.linalg.solve(seen.covariance, error))
    sd = np.std(errors, axis=0, ddof=1)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 3 * sd / np.sqrt(30) + 2e-5)
    assert np.all(sd < [5e-5, 5e-5, 2e-4])
    # Neighbouring corners share a side, so their errors are not independent: sigma within a
    # factor of two of the truth, and no more outliers than a chi-square has.
    assert 3 / 4 < np.mean(normalised) < 3 * 4
    assert np.mean(np.array(normalised) < stats.chi2.ppf(0.95, 3)) > 0.75
    assert eye.corner_sigma_px is not None and 0.005 < eye.corner_sigma_px < 0.03


def test_error_grows_with_the_square_of_depth_and_sigma_says_so() -> None:
    """Depth sigma ~ z^2 / (f B): three times as far is nine times as uncertain, and worse."""
    rng = np.random.default_rng(2)
    eye = eye_for()
    near, far = (
        eye.measure(*render(marker_pose(HEAD, z), PLATE, HEAD, rng), 0) for z in (0.8, 2.4)
    )
    ratio = np.sqrt(far.covariance_camera[2, 2] / near.covariance_camera[2, 2])
    assert 6 < ratio < 30
    assert far.covariance_camera[2, 2] > far.covariance_camera[0, 0]


def test_charuco_board_is_measured_by_the_same_code() -> None:
    rng = np.random.default_rng(4)
    eye = eye_for(target=CharucoTarget(0.04, 0.03, 5, 5))
    truth = marker_pose(HEAD, 1.0, rng)
    seen = eye.measure(*render(truth, charuco_plate(0.04, 0.03, 5, 5), HEAD, rng), 0)
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
        seen = eye.measure(*render(truth, PLATE, head, rng), 0)
        error = np.linalg.inv(head.camera_in_base)[:3, :3] @ (seen.point - truth[:3, 3])
        assert np.all(np.abs(error) < [1e-4, 1e-4, 5e-4])
        assert np.abs(seen.pose[:3, :3] - truth[:3, :3]).max() < 0.02


def test_rectified_and_raw_give_the_same_where_there_is_no_distortion() -> None:
    left, right = pair()
    raw, rectified = (eye_for(rectified=r).measure(left, right, 5) for r in (False, True))
    np.testing.assert_allclose(raw.point, rectified.point, atol=1e-9)
    assert raw.stamp_ns == 5


def test_tip_away_from_the_marker_with_the_covariance_of_the_lever() -> None:
    left, right = pair()
    tip = np.array([0.02, -0.1, 0.03])
    centre, offset = (
        eye_for().measure(left, right, 0),
        eye_for(tip_in_marker=tip).measure(left, right, 0),
    )
    np.testing.assert_allclose(offset.point, (centre.pose @ [*tip, 1.0])[:3], atol=1e-12)
    assert np.trace(offset.covariance) > np.trace(centre.covariance)
    turn = HEAD.camera_in_base[:3, :3]
    np.testing.assert_allclose(
        offset.covariance, turn @ offset.covariance_camera @ turn.T, atol=1e-15
    )


def test_a_print_of_the_wrong_size_moves_the_scale_not_the_point() -> None:
    """1 % too large: pure size-from-perspective would be 12 mm off at 1.2 m."""
    rng = np.random.default_rng(8)
    truth = marker_pose(HEAD, 1.2, rng)
    large = render(truth, tag_plate(0.06, print_scale=1.01), HEAD, rng)
    seen = eye_for(limits=Limits(size_tolerance=0.02)).measure(*large, 0)
    assert seen.scale == pytest.approx(1.01, abs=0.002)
    assert np.linalg.norm(seen.point - truth[:3, 3]) < 3e-4


def test_the_cameras_share_nothing_with_the_measurement() -> None:
    """Or an error of convention would cancel in every test above."""
    for module in (cameras, plates):
        assert module.__file__ is not None
        assert "longarm_comp.devices" not in Path(module.__file__).read_text(encoding="utf-8")


# ---- refusals -----------------------------------------------------------------------------------

FAULTS = {
    Reason.TOO_DARK: Conditions(exposure=0.02),
    Reason.TOO_BRIGHT: Conditions(exposure=40.0),
    Reason.BLURRED: Conditions(blur_px=7.0),
    Reason.NOT_FOUND_LEFT: Conditions(covered=(0.5, 0.0)),
    Reason.NOT_FOUND_RIGHT: Conditions(covered=(0.0, 0.5)),
}


@pytest.mark.parametrize("reason", FAULTS, ids=lambda reason: reason.name)
def test_bad_pictures_are_refused_with_the_right_reason(reason: Reason) -> None:
    eye = eye_for()
    with pytest.raises(StereoRefusal) as refusal:
        eye.measure(*pair(FAULTS[reason]), 0)
    assert refusal.value.reason is reason
    assert refusal.value.facts["image"] in ("left", "right")
    assert eye.refusals == {reason: 1} and eye.sightings == 0
    assert eye.measure(*pair(), 1).corners == 4  # and the eye goes on


def test_a_blur_that_still_lets_the_tag_be_read_is_refused_too() -> None:
    with pytest.raises(StereoRefusal) as refusal:
        eye_for(limits=Limits(edge_px=1.2)).measure(*pair(Conditions(blur_px=2.0)), 0)
    assert refusal.value.reason is Reason.BLURRED
    assert refusal.value.facts["edge_px"] == pytest.approx(2.0, abs=0.4)


def test_half_a_board_each_is_occluded() -> None:
    """Left sees the right column of tags, right sees everything: two tags are common."""
    plate, target = tag_plate(0.04, 0.01, 2, 2), TagBoard(0.04, 0.01, 2, 2)
    half = pair(Conditions(covered=(0.5, 0.0)), plate, 1.0)
    assert eye_for(target=target).measure(*half, 0).corners == 8
    eye = eye_for(target=target, limits=Limits(seen_share=0.75))
    with pytest.raises(StereoRefusal) as refusal:
        eye.measure(*half, 0)
    assert refusal.value.reason is Reason.OCCLUDED
    assert refusal.value.facts == {"corners": 8, "of": 16}


def test_whatever_the_picture_the_answer_is_right_or_a_refusal() -> None:
    """Dark, saturated, noisy, blurred, moving, half hidden, askew: never a silent wrong point."""
    rng = np.random.default_rng(15)
    boards = [(PLATE, TAG), (tag_plate(0.04, 0.01, 2, 2), TagBoard(0.04, 0.01, 2, 2))]
    measured, refused = 0, 0
    for case in range(40):
        plate, target = boards[case % 2]
        conditions = Conditions(
            exposure=float(rng.choice([0.1, 0.4, 0.75, 1.5, 3.0])),
            read_noise=float(rng.choice([1.0, 4.0, 10.0])),
            blur_px=float(rng.choice([0.3, 0.6, 1.2, 2.5])),
            motion_px=tuple(rng.uniform(-6, 6, 2)) if case % 3 == 0 else (0.0, 0.0),
            covered=tuple(rng.choice([0.0, 0.0, 0.0, 0.1, 0.5], 2)),
        )
        truth = marker_pose(HEAD, rng.uniform(0.7, 2.0), rng)
        try:
            seen = eye_for(target=target).measure(*render(truth, plate, HEAD, rng, conditions), 0)
        except StereoRefusal:
            refused += 1
            continue
        measured += 1
        error = seen.point - truth[:3, 3]
        assert np.linalg.norm(error) < 5e-3
        assert error @ np.linalg.solve(seen.covariance, error) < 8.0**2
    assert measured > 8 and refused > 8
    noise = rng.integers(0, 256, (2, 480, 640), dtype=np.uint8)
    with pytest.raises(StereoRefusal):
        eye_for().measure(noise[0], noise[1], 0)


def test_wrong_size_and_wrong_kind_of_image() -> None:
    left, right = pair()
    for bad, reason in [
        (left[:240], Reason.WRONG_SIZE),
        (left.astype(float), Reason.BAD_IMAGE),
        (left[None], Reason.BAD_IMAGE),
    ]:
        with pytest.raises(StereoRefusal) as refusal:
            eye_for().measure(bad, right, 0)
        assert refusal.value.reason is reason
    colour = cv2.cvtColor(left, cv2.COLOR_GRAY2BGR)
    assert eye_for().measure(colour, right, 0).corners == 4


def test_shifted_swapped_and_repeated_markers() -> None:
    left, right = pair()
    lowered = np.roll(right, 6, axis=0)  # the right camera has been knocked
    doubled = left.copy()
    doubled[:, :300] = left[:, -300:]
    doubled[:, -300:] = left[:, -300:]
    x = round(HEAD.k[0, 2] + HEAD.focal_px * 0.15 / 1.2)
    doubled[:200, :200] = left[140:340, x - 100 : x + 100]
    for images, reason in [
        ((left, lowered), Reason.EPIPOLAR),
        ((right, left), Reason.BEHIND_CAMERA),
        ((doubled, right), Reason.AMBIGUOUS),
    ]:
        with pytest.raises(StereoRefusal) as refusal:
            eye_for().measure(*images, 0)
        assert refusal.value.reason is reason


def test_a_marker_of_another_size_than_declared() -> None:
    with pytest.raises(StereoRefusal) as refusal:
        eye_for(target=TagBoard(0.05)).measure(*pair(), 0)
    assert refusal.value.reason is Reason.MARKER_SIZE
    assert refusal.value.facts["seen_over_declared"] == pytest.approx(1.2, abs=0.01)


def test_a_board_that_is_not_what_is_declared_does_not_fit() -> None:
    """A 2x2 board whose declared gap is 5 mm too small: size within 10 %, shape not."""
    images = pair(plate=tag_plate(0.04, 0.01, 2, 2), depth=1.0)
    eye = eye_for(target=TagBoard(0.04, 0.005, 2, 2), limits=Limits(size=0.2))
    with pytest.raises(StereoRefusal) as refusal:
        eye.measure(*images, 0)
    assert refusal.value.reason is Reason.REPROJECTION
    assert refusal.value.facts["rms_px"] > 0.8


@pytest.mark.parametrize(
    "change",
    [
        {"p": (0.0,) * 12},
        {"k": (0.0,) * 9},
        {"p": (np.nan,) * 12},
        {"p": tuple(np.hstack([HEAD.k, np.zeros((3, 1))]).ravel())},
    ],
    ids=["zero P", "zero K", "nan", "no baseline"],
)
def test_an_uncalibrated_camera_is_refused(change: dict[str, Any]) -> None:
    left, right = HEAD.camera_infos()
    with pytest.raises(StereoRefusal) as refusal:
        StereoRig.from_camera_info(left, dataclasses.replace(right, **change), rectified=False)
    assert refusal.value.reason is Reason.UNCALIBRATED


def test_refusals_survive_a_process_boundary() -> None:
    back = pickle.loads(pickle.dumps(StereoRefusal(Reason.BLURRED, edge_px=3.2)))  # noqa: S301
    assert back.reason is Reason.BLURRED and back.facts == {"edge_px": 3.2}
    assert str(back) == "image is blurred (edge_px=3.2)"


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


def test_triangulation_is_exact_and_its_covariance_is_what_noise_does() -> None:
    head = dataclasses.replace(
        HEAD, d=(-0.2, 0.05, 0.0, 0.0, 0.0), right_turn_rad=(0.0, -0.03, 0.0)
    )
    rig = StereoRig.from_camera_info(*head.camera_infos(), rectified=False)
    points = np.repeat([[0.1, -0.05, 1.5]], 4000, axis=0)
    left, right = rig.left.project(points)[0], rig.right.project(points)[0]
    exact = triangulate(rig, left[:3], right[:3])
    np.testing.assert_allclose(exact.points, points[:3], atol=1e-9)
    rng = np.random.default_rng(9)
    noisy = triangulate(
        rig, left + rng.normal(0, 0.2, left.shape), right + rng.normal(0, 0.2, right.shape)
    )
    assert noisy.sigma_px == pytest.approx(0.2, rel=0.05)
    np.testing.assert_allclose(
        np.sqrt(np.diag(np.cov(noisy.points.T))),
        np.sqrt(np.diag(noisy.covariances.mean(axis=0))),
        rtol=0.05,
    )


def test_rigid_fit_recovers_a_motion_and_knows_its_error() -> None:
    rng = np.random.default_rng(10)
    truth = np.eye(4)
    truth[:3, :3] = cv2.Rodrigues(np.array([2.0, -1.0, 0.4]))[0]
    truth[:3, 3] = [0.75, -1.7, 0.3]
    source = rng.uniform(-0.4, 0.4, (30, 3))
    covariance = np.broadcast_to(np.diag([1e-4, 1e-4, 1e-3]) ** 2, (30, 3, 3))
    normalised = []
    for _ in range(60):
        noise = rng.normal(0.0, [1e-4, 1e-4, 1e-3], (30, 3))
        fit = fit_rigid(source, source @ truth[:3, :3].T + truth[:3, 3] + noise, covariance)
        turn = cv2.Rodrigues(fit.transform[:3, :3] @ truth[:3, :3].T)[0].ravel()
        error = np.concatenate([fit.transform[:3, 3] - truth[:3, 3], turn])
        normalised.append(error @ np.linalg.solve(fit.covariance, error))
    assert 4.5 < np.mean(normalised) < 7.5  # chi-square with 6 degrees of freedom, 60 draws
    with pytest.raises(InputError, match="line"):
        fit_rigid(np.outer(np.arange(4.0), [1, 2, 3]), np.outer(np.arange(4.0), [1, 2, 3]))


# ---- hand-eye -----------------------------------------------------------------------------------

CAMERA = HEAD.camera_in_base
SIGMA_M = np.array([1e-4, 1e-4, 5e-4])


def session(rng: np.random.Generator, marker_in_tip: np.ndarray, count: int = 25) -> Any:
    """Tip poses (N, 4, 4) all over the workspace, markers seen with noise, and its covariance."""
    tips = np.tile(np.eye(4), (count, 1, 1))
    for tip in tips:
        tip[:3, :3] = cv2.Rodrigues(rng.uniform(-0.8, 0.8, 3))[0]
        tip[:3, 3] = rng.uniform([0.4, -0.3, 0.1], [1.1, 0.3, 0.7])
    marker = tips[:, :3, :3] @ marker_in_tip + tips[:, :3, 3]
    seen = (marker - CAMERA[:3, 3]) @ CAMERA[:3, :3] + rng.normal(0.0, SIGMA_M, (count, 3))
    return tips, seen, np.broadcast_to(np.diag(SIGMA_M**2), (count, 3, 3))


@pytest.mark.parametrize("known", [True, False], ids=["marker known", "marker unknown"])
def test_hand_eye_finds_the_camera_with_an_honest_covariance(known: bool) -> None:
    rng = np.random.default_rng(12)
    place = np.array([0.03, -0.05, 0.02])
    normalised = []
    for _ in range(40):
        fit = hand_eye(*session(rng, place), marker_in_tip=place if known else None)
        turn = cv2.Rodrigues(fit.camera_in_base[:3, :3] @ CAMERA[:3, :3].T)[0].ravel()
        error = np.concatenate([fit.camera_in_base[:3, 3] - CAMERA[:3, 3], turn])
        if not known:
            error = np.concatenate([error, fit.marker_in_tip - place])
        normalised.append(error @ np.linalg.solve(fit.covariance, error) / len(error))
        assert not fit.outliers
    assert 0.75 < np.mean(normalised) < 1.25


def test_hand_eye_leaves_an_outlier_out_and_refuses_what_it_cannot_tell() -> None:
    rng = np.random.default_rng(13)
    tips, seen, covariances = session(rng, np.zeros(3))
    seen[7] += [0.0, 0.05, 0.0]
    fit = hand_eye(tips, seen, covariances)
    assert fit.outliers == (7,)
    assert fit.rms_m < 1e-3 and np.linalg.norm(fit.residuals[7]) > 0.04
    tips[:, :3, :3] = np.eye(3)  # the tip never turns: place and camera cannot be told apart
    with pytest.raises(JobError, match="turn the tip"):
        hand_eye(tips, seen, covariances)
    with pytest.raises(InputError, match="postures"):
        hand_eye(tips[:2], seen[:2], covariances[:2])


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
    seen = eye.measure(*render(truth, PLATE, head, rng), 0)
    assert np.linalg.norm(seen.point - truth[:3, 3]) < 3e-3


# ---- pairing ------------------------------------------------------------------------------------

MS = 1_000_000


def feed(pairer: StereoPairer[str], *arrivals: tuple[Side, int]) -> list[tuple[str, str]]:
    found = []
    for side, milliseconds in arrivals:
        name = f"{side.name[0]}{milliseconds}"
        found += [(p.left, p.right) for p in pairer.add(side, milliseconds * MS, name)]
    return found


L, R = Side.LEFT, Side.RIGHT


def test_pairs_in_any_order_of_arrival_within_the_slop() -> None:
    pairer: StereoPairer[str] = StereoPairer(slop_ns=5 * MS)
    assert feed(pairer, (L, 0), (R, 3), (R, 35), (L, 33), (L, 66), (L, 100), (R, 65)) == [
        ("L0", "R3"),
        ("L33", "R35"),
        ("L66", "R65"),
    ]
    assert pairer.pairs == 3 and not pairer.drops and pairer.waiting == (1, 0)


def test_images_without_a_partner_are_dropped_and_counted() -> None:
    pairer: StereoPairer[str] = StereoPairer(slop_ns=5 * MS, queue=3)
    assert feed(pairer, (L, 0), (L, 33), (R, 34), (R, 50), (L, 66), (R, 66)) == [
        ("L33", "R34"),
        ("L66", "R66"),
    ]
    assert pairer.drops == {Drop.UNSYNCHRONISED: 2}
    feed(pairer, *[(L, 100 + 33 * i) for i in range(5)])  # the right camera died
    assert pairer.drops[Drop.OVERFLOW] == 2 and pairer.waiting == (3, 0)


def test_the_nearer_partner_wins() -> None:
    pairer: StereoPairer[str] = StereoPairer(slop_ns=20 * MS)
    assert feed(pairer, (L, 0), (L, 12), (R, 14)) == [("L12", "R14")]


def test_late_images_and_a_clock_that_jumps_back() -> None:
    pairer: StereoPairer[str] = StereoPairer(slop_ns=5 * MS)
    assert feed(pairer, (L, 5000), (R, 5001), (L, 4990), (L, 5000)) == [("L5000", "R5001")]
    assert pairer.drops == {Drop.OUT_OF_ORDER: 2}
    assert feed(pairer, (L, 5033), (L, 10), (R, 11), (L, 43), (R, 43)) == [
        ("L10", "R11"),
        ("L43", "R43"),
    ]
    assert pairer.drops[Drop.RESTARTED] == 1


# ---- what users may type ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        lambda: TagBoard(0.0),
        lambda: TagBoard(0.05, dictionary="DICT_5X5"),
        lambda: TagBoard(0.05, columns=8, rows=8, first_id=0),
        lambda: CharucoTarget(0.04, 0.05, 5, 5),
        lambda: Chessboard(0.02, 7, 5),
        lambda: Limits(seen_share=1.5),
        lambda: Limits(size=0.0),
        lambda: PixelNoise(0.0),
        lambda: StereoPairer(slop_ns=-1),
        lambda: eye_for(tip_in_marker=(0.0, np.nan, 0.0)),
        lambda: StereoEye(eye_for().rig, TAG, np.diag([1.0, 1.0, -1.0, 1.0])),
    ],
)
def test_bad_settings_are_one_clear_error(make: Any) -> None:
    with pytest.raises(InputError):
        make()
