"""The calibration of one camera, with the fields of a sensor_msgs/CameraInfo."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraInfo:
    """The fields of a sensor_msgs/CameraInfo that a stereo pair needs."""

    width: int  # width, height: of the image, px
    height: int
    distortion_model: str  # such as ``plumb_bob``
    d: tuple[float, ...]  # coefficients of it, in OpenCV's order
    k: tuple[float, ...]
    """k, r, p: intrinsic (9), rectification (9) and projection (12) matrix, row by row."""
    r: tuple[float, ...]
    p: tuple[float, ...]
