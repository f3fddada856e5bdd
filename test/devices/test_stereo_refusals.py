"""Pictures, cameras and settings that the stereo measurement refuses, each with its reason."""

import dataclasses
import pickle
from typing import Any

import cv2
import numpy as np
import pytest
from stereo_head import HEAD, PLATE, TAG, eye_for, marker_pose, pair

from longarm_comp.core.errors import InputError
from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.found import Limits
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal
from longarm_comp.devices.stereo.target import CharucoTarget, TagBoard
from longarm_comp.sim.cameras import Conditions, render, tag_plate

# ---- refusals -----------------------------------------------------------------------------------

FAULTS = {
    RefusalReason.TOO_DARK: Conditions(exposure=0.02),
    RefusalReason.TOO_BRIGHT: Conditions(exposure=40.0),
    RefusalReason.BLURRED: Conditions(blur_px=7.0),
    RefusalReason.NOT_FOUND_LEFT: Conditions(covered=(0.5, 0.0)),
    RefusalReason.NOT_FOUND_RIGHT: Conditions(covered=(0.0, 0.5)),
}


@pytest.mark.parametrize("reason", FAULTS, ids=lambda reason: reason.name)
def test_bad_pictures_are_refused_with_the_right_reason(reason: RefusalReason) -> None:
    eye = eye_for()
    with pytest.raises(StereoRefusal) as refusal:
        eye.measure(*pair(FAULTS[reason]))
    assert refusal.value.reason is reason
    assert refusal.value.facts["image"] in ("left", "right")
    assert eye.measure(*pair()).corners == 4  # and the eye goes on


def test_a_blur_that_still_lets_the_tag_be_read_is_refused_too() -> None:
    with pytest.raises(StereoRefusal) as refusal:
        eye_for(limits=Limits(edge_px=1.2)).measure(*pair(Conditions(blur_px=2.0)))
    assert refusal.value.reason is RefusalReason.BLURRED
    assert refusal.value.facts["edge_px"] == pytest.approx(2.0, abs=0.4)


def test_half_a_board_each_is_occluded() -> None:
    """Left sees the right column of tags, right sees everything: two tags are common."""
    plate, target = tag_plate(0.04, 0.01, 2, 2), TagBoard(0.04, 0.01, 2, 2)
    half = pair(Conditions(covered=(0.5, 0.0)), plate, 1.0)
    assert eye_for(target=target).measure(*half).corners == 8
    eye = eye_for(target=target, limits=Limits(seen_share=0.75))
    with pytest.raises(StereoRefusal) as refusal:
        eye.measure(*half)
    assert refusal.value.reason is RefusalReason.OCCLUDED
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
            seen = eye_for(target=target).measure(*render(truth, plate, HEAD, rng, conditions))
        except StereoRefusal:
            refused += 1
            continue
        measured += 1
        error = seen.point - truth[:3, 3]
        assert np.linalg.norm(error) < 5e-3
        assert error @ np.linalg.solve(seen.pose_covariance[:3, :3], error) < 8.0**2
    assert measured > 8 and refused > 8
    noise = rng.integers(0, 256, (2, 480, 640), dtype=np.uint8)
    with pytest.raises(StereoRefusal):
        eye_for().measure(noise[0], noise[1])


def test_an_image_of_another_size_and_one_in_colour() -> None:
    left, right = pair()
    with pytest.raises(StereoRefusal) as refusal:
        eye_for().measure(left[:240], right)
    assert refusal.value.reason is RefusalReason.WRONG_SIZE
    colour = cv2.cvtColor(left, cv2.COLOR_GRAY2BGR)
    assert eye_for().measure(colour, right).corners == 4


def test_shifted_swapped_and_repeated_markers() -> None:
    left, right = pair()
    lowered = np.roll(right, 6, axis=0)  # the right camera has been knocked
    doubled = left.copy()
    doubled[:, :300] = left[:, -300:]
    doubled[:, -300:] = left[:, -300:]
    x = round(HEAD.k[0, 2] + HEAD.focal_px * 0.15 / 1.2)
    doubled[:200, :200] = left[140:340, x - 100 : x + 100]
    for images, reason in [
        ((left, lowered), RefusalReason.EPIPOLAR),
        ((right, left), RefusalReason.BEHIND_CAMERA),
        ((doubled, right), RefusalReason.AMBIGUOUS),
    ]:
        with pytest.raises(StereoRefusal) as refusal:
            eye_for().measure(*images)
        assert refusal.value.reason is reason


def test_a_marker_of_another_size_than_declared() -> None:
    with pytest.raises(StereoRefusal) as refusal:
        eye_for(target=TagBoard(0.05)).measure(*pair())
    assert refusal.value.reason is RefusalReason.MARKER_SIZE
    assert refusal.value.facts["seen_over_declared"] == pytest.approx(1.2, abs=0.01)


def test_a_board_that_is_not_what_is_declared_does_not_fit() -> None:
    """A 2x2 board whose declared gap is 5 mm too small: size within 10 %, shape not."""
    images = pair(plate=tag_plate(0.04, 0.01, 2, 2), depth=1.0)
    eye = eye_for(target=TagBoard(0.04, 0.005, 2, 2), limits=Limits(size=0.2))
    with pytest.raises(StereoRefusal) as refusal:
        eye.measure(*images)
    assert refusal.value.reason is RefusalReason.REPROJECTION
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
    assert refusal.value.reason is RefusalReason.UNCALIBRATED


def test_refusals_survive_a_process_boundary() -> None:
    back = pickle.loads(pickle.dumps(StereoRefusal(RefusalReason.BLURRED, edge_px=3.2)))  # noqa: S301
    assert back.reason is RefusalReason.BLURRED and back.facts == {"edge_px": 3.2}
    assert str(back) == "image is blurred (edge_px=3.2)"


# ---- what users may type ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        lambda: TagBoard(0.0),
        lambda: TagBoard(0.05, dictionary="DICT_5X5"),
        lambda: TagBoard(0.05, columns=8, rows=8, first_id=0),
        lambda: CharucoTarget(0.04, 0.05, 5, 5),
    ],
)
def test_bad_settings_are_one_clear_error(make: Any) -> None:
    with pytest.raises(InputError):
        make()
