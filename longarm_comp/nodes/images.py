"""Conversions between image messages and arrays, and of camera calibrations to messages."""

from __future__ import annotations

import array

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image

from longarm_comp.devices.stereo import CameraInfoLike, RefusalReason, StereoRefusal
from longarm_comp.nodes.stamps import stamp_of

Grey = NDArray[np.uint8]
_CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4}
_TO_BGR = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
}


def pixels_of(message: Image) -> Grey:
    """(H, W) grey or (H, W, 3) BGR.

    Raises:
        StereoRefusal: BAD_IMAGE, for an unsupported encoding or data of another size than stated.
    """
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        allowed = " ".join(_CHANNELS)
        raise StereoRefusal(RefusalReason.BAD_IMAGE, encoding=message.encoding, allowed=allowed)
    width = message.width * channels
    if len(message.data) != message.height * message.step or message.step < width or not width:
        size = f"{message.width}x{message.height}, step {message.step}, {len(message.data)} bytes"
        raise StereoRefusal(RefusalReason.BAD_IMAGE, size=size)
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    pixels = rows[:, :width].reshape(message.height, message.width, channels)
    if message.encoding in _TO_BGR:
        return np.asarray(cv2.cvtColor(pixels, _TO_BGR[message.encoding]), dtype=np.uint8)
    return pixels[:, :, 0] if channels == 1 else pixels


def image_message(grey: Grey, ns: int, frame: str) -> Image:
    """Message of a grey image (H, W), uint8."""
    height, width = grey.shape
    message = Image(height=height, width=width, encoding="mono8", step=width)
    message.data = array.array("B", np.ascontiguousarray(grey).tobytes())
    message.header.stamp, message.header.frame_id = stamp_of(ns), frame
    return message


def info_message(info: CameraInfoLike, ns: int, frame: str) -> CameraInfo:
    """Message of a camera's calibration."""
    message = CameraInfo(
        width=info.width, height=info.height, distortion_model=info.distortion_model,
        d=list(info.d), k=list(info.k), r=list(info.r), p=list(info.p),
    )  # fmt: skip
    message.header.stamp, message.header.frame_id = stamp_of(ns), frame
    return message


def same_camera(a: CameraInfo, b: CameraInfo) -> bool:
    """Whether two messages hold the same calibration."""
    keys = ("width", "height", "distortion_model", "d", "k", "r", "p")
    return all(np.array_equal(getattr(a, key), getattr(b, key)) for key in keys)
