"""The calibration of one camera, with the fields of a sensor_msgs/CameraInfo."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraInfo:
    """What a stereo pair needs of a sensor_msgs/CameraInfo.

    Attributes:
        width, height: of the image, px.
        distortion_model: such as ``plumb_bob``.
        d: coefficients of it, in OpenCV's order.
        k, r, p: intrinsic (9), rectification (9) and projection (12) matrix, row by row.
    """

    width: int
    height: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]
