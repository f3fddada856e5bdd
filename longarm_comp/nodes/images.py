"""Images of cameras: subscriptions that count losses, conversions of messages, calibrations."""

import array
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from longarm_comp.devices.camera_info import CameraInfo as Calibration
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal
from longarm_comp.nodes.clock import stamp_of
from longarm_comp.nodes.interfaces import BEST_EFFORT, RELIABLE, Topic
from longarm_comp.nodes.worker import SequenceWatch

Grey = NDArray[np.uint8]
Samples = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True)
class _PixelFormat:
    """A format of an image's bytes, with its conversion to pixels."""

    samples: int  # numbers per pixel
    convert: Callable[[Grey], Grey]
    """Converts 8-bit numbers (H, W, samples) to pixels: (H, W) grey or (H, W, 3) BGR."""
    wide: bool = False  # the numbers have 16 bits


def _take_sample(k: int) -> Callable[[Grey], Grey]:
    return lambda numbers: numbers[:, :, k]


def _convert_by(code: int) -> Callable[[Grey], Grey]:
    return lambda numbers: np.asarray(cv2.cvtColor(numbers, code), dtype=np.uint8)


# Names of sensor_msgs/image_encodings.hpp. In YUV images every second byte is the brightness Y.
ENCODINGS: dict[str, _PixelFormat] = {
    **dict.fromkeys(("mono8", "8UC1"), _PixelFormat(1, _take_sample(0))),
    **dict.fromkeys(("mono16", "16UC1"), _PixelFormat(1, _take_sample(0), wide=True)),
    **dict.fromkeys(("bgr8", "8UC3"), _PixelFormat(3, lambda numbers: numbers)),
    "rgb8": _PixelFormat(3, _convert_by(cv2.COLOR_RGB2BGR)),
    **dict.fromkeys(("bgra8", "8UC4"), _PixelFormat(4, _convert_by(cv2.COLOR_BGRA2BGR))),
    "rgba8": _PixelFormat(4, _convert_by(cv2.COLOR_RGBA2BGR)),
    **dict.fromkeys(("yuv422", "uyvy"), _PixelFormat(2, _take_sample(1))),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), _PixelFormat(2, _take_sample(0))),
}
for _order in ("rggb", "bggr", "gbrg", "grbg"):
    _brightness = _convert_by(getattr(cv2, f"COLOR_Bayer{_order.upper()}2GRAY"))
    ENCODINGS[f"bayer_{_order}8"] = _PixelFormat(1, _brightness)
    ENCODINGS[f"bayer_{_order}16"] = _PixelFormat(1, _brightness, wide=True)


def pixels_of(message: Image) -> Grey:
    """Return the pixels of an image: (H, W) grey or (H, W, 3) BGR.

    Raises:
        StereoRefusal: BAD_IMAGE, if the encoding is not supported or the data have a wrong size.
    """
    encoding = ENCODINGS.get(message.encoding)
    if encoding is None:
        allowed = " ".join(ENCODINGS)
        raise StereoRefusal(RefusalReason.BAD_IMAGE, encoding=message.encoding, allowed=allowed)
    width = message.width * encoding.samples * (2 if encoding.wide else 1)
    if len(message.data) != message.height * message.step or message.step < width or not width:
        size = f"{message.width}x{message.height}, step {message.step}, {len(message.data)} bytes"
        raise StereoRefusal(RefusalReason.BAD_IMAGE, size=size)
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)[:, :width]
    if encoding.wide:
        rows = _to_8_bits(np.ascontiguousarray(rows).view(">u2" if message.is_bigendian else "<u2"))
    return encoding.convert(rows.reshape(message.height, message.width, encoding.samples))


def decode(message: CompressedImage) -> Grey:
    """Decode a compressed image of image_transport to grey pixels (H, W), uint8.

    Raises:
        StereoRefusal: BAD_IMAGE, if the data are no image.
    """
    data = np.frombuffer(message.data, np.uint8)
    try:
        numbers = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH) if len(data) else None
    except cv2.error:
        numbers = None
    if numbers is None:
        what = f"{message.format!r}, {len(data)} bytes"
        raise StereoRefusal(RefusalReason.BAD_IMAGE, compressed=what, allowed="jpeg or png")
    grey = _to_8_bits(numbers)
    source, _, packed = message.format.partition(";")
    if "bgr8" in packed or not source.startswith("bayer_"):
        return grey
    return ENCODINGS[source.strip()].convert(grey) if source.strip() in ENCODINGS else grey


def _to_8_bits(numbers: Samples) -> Grey:
    """Return the highest 8 bits that occur in the image: cameras leave some of the 16 empty."""
    if numbers.dtype == np.uint8:
        return numbers.astype(np.uint8, copy=False)
    used = int(numbers.max(initial=0)).bit_length()
    return (numbers >> max(0, used - 8)).astype(np.uint8)


def image_message(grey: Grey, ns: int, frame: str) -> Image:
    """Make the message of a grey image (H, W), uint8; ``ns`` is its time stamp, ns."""
    height, width = grey.shape
    return Image(
        header=Header(stamp=stamp_of(ns), frame_id=frame),
        height=height,
        width=width,
        step=width,
        encoding="mono8",
        data=array.array("B", np.ascontiguousarray(grey).tobytes()),
    )


def info_message(info: Calibration, ns: int, frame: str) -> CameraInfo:
    """Make the CameraInfo message of a camera's calibration; ``ns`` is its time stamp, ns."""
    return CameraInfo(header=Header(stamp=stamp_of(ns), frame_id=frame), **asdict(info))


def is_same_camera(a: Calibration, b: Calibration) -> bool:
    """Tell whether two messages or records hold the same calibration."""
    keys = [field.name for field in fields(Calibration)]
    return all(np.array_equal(getattr(a, key), getattr(b, key)) for key in keys)


class ImageInlet:
    """A subscription to images whose reliability fits the present publishers.

    A reliable subscription receives nothing from a best-effort publisher, without any warning.
    ``watch`` counts images that the middleware lost or that a full queue dropped.

    ``reliable``: subscribe reliably if every publisher offers it; else always best effort.
    """

    def __init__(
        self, node: Node, topic: Topic, take: Callable[[Any], None], *, reliable: bool
    ) -> None:
        self._node, self._topic, self._take = node, topic, take
        self._reliable, self.watch = reliable, SequenceWatch()
        self._subscription: Any = None
        self._how: ReliabilityPolicy | None = None
        self.adapt()

    @property
    def reliability(self) -> str:
        return "reliable" if self._how is RELIABLE else "best effort"

    def adapt(self) -> None:
        """Subscribe again if the present publishers need another reliability."""
        name = self._node.resolve_topic_name(self._topic.name)
        ends = self._node.get_publishers_info_by_topic(name)
        offered = all(end.qos_profile.reliability is not BEST_EFFORT for end in ends)
        wanted = RELIABLE if self._reliable and offered else BEST_EFFORT
        if wanted is self._how:
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._how = wanted
        self._subscription = self._topic.subscription(self._node, self._hear_image, listens=wanted)

    def _hear_image(self, message: Any, info: Any) -> None:
        self.watch.count([info["publication_sequence_number"] or 0], full=True)
        self._take(message)
