"""Reasons for which a stereo pair gives no measurement."""

import enum

from longarm_comp.core.errors import JobError


class RefusalReason(str, enum.Enum):
    """Reasons to refuse a pair of images."""

    UNCALIBRATED = "camera is not calibrated"
    BAD_IMAGE = "image is not 8-bit grey or colour"
    WRONG_SIZE = "image size differs from the calibration"
    TOO_DARK = "image is too dark"
    TOO_BRIGHT = "image is over-exposed"
    BLURRED = "image is blurred"
    NOT_FOUND_LEFT = "marker not found in the left image"
    NOT_FOUND_RIGHT = "marker not found in the right image"
    AMBIGUOUS = "the same marker is seen twice"
    OCCLUDED = "too few corners are seen by both cameras"
    EPIPOLAR = "corners violate the epipolar constraint"
    BEHIND_CAMERA = "corners triangulate behind the camera"
    REPROJECTION = "reprojection error is too large"
    MARKER_SIZE = "marker has another size than declared"

    def __str__(self) -> str:
        return self.value


class StereoRefusal(JobError):  # noqa: N818 - a refusal is an answer, not a fault
    """A pair of images, or a camera, that cannot be used for a measurement.

    Args:
        reason: the reason of the refusal.
        facts: values that explain the refusal, with units in their names (``rms_px=3.1``).
    """

    reason: RefusalReason

    def __init__(self, reason: RefusalReason, **facts: object) -> None:
        super().__init__(reason.value, **facts)
        self.reason = reason
