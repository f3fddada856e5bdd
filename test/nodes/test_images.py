"""Every encoding that cameras send: the real detector finds the tip on rendered pairs of it."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest
from stereo_head import eye_for, pair

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from sensor_msgs.msg import CompressedImage, Image

from longarm_comp.devices.stereo.refusal import StereoRefusal
from longarm_comp.nodes.images import ENCODINGS, decode, pixels_of

# Where red, green and blue lie in a square of four pixels: row, column.
MOSAIC = {
    "rggb": ((0, 0), (1, 1)), "bggr": ((1, 1), (0, 0)),
    "grbg": ((0, 1), (1, 0)), "gbrg": ((1, 0), (0, 1)),
}  # fmt: skip


def image(encoding: str, numbers: np.ndarray, big: bool = False) -> Image:
    """A message of numbers (H, W, ...), with six bytes of padding at the end of each row."""
    height, width = numbers.shape[:2]
    rows = numbers.astype(numbers.dtype.newbyteorder(">" if big else "<")).view(np.uint8)
    rows = np.pad(rows.reshape(height, -1), ((0, 0), (0, 6)), constant_values=77)
    message = Image(height=height, width=width, encoding=encoding, is_bigendian=int(big))
    message.step, message.data = rows.shape[1], rows.tobytes()
    return message


def mosaic(order: str, bgr: np.ndarray) -> np.ndarray:
    """What a sensor behind a Bayer filter reads of a picture (H, W, 3)."""
    made = bgr[:, :, 1].copy()
    for (row, column), channel in zip(MOSAIC[order], (2, 0), strict=True):
        made[row::2, column::2] = bgr[row::2, column::2, channel]
    return made


def tinted(grey: np.ndarray) -> np.ndarray:
    """The scene in warm light, (H, W, 3) BGR."""
    return (grey[:, :, None] * np.array([0.5, 0.8, 1.0])).astype(np.uint8)


def interleaved(grey: np.ndarray, *, first: bool) -> np.ndarray:
    """Brightness and colour in turn (YUV 4:2:2)."""
    colour = np.full_like(grey, 128)
    colour[:, ::2] = 90
    return np.stack([grey, colour] if first else [colour, grey], axis=2)


SENT: dict[str, Callable[[np.ndarray], Image]] = {
    "mono8": lambda g: image("mono8", g),
    "mono16": lambda g: image("mono16", g.astype(np.uint16) * 257),
    "12 bits in mono16": lambda g: image("mono16", g.astype(np.uint16) * 16 + 3),
    "big-endian": lambda g: image("16UC1", g.astype(np.uint16) * 256 + 85, big=True),
    "rgb8": lambda g: image("rgb8", tinted(g)[:, :, ::-1]),
    "bgra8": lambda g: image("bgra8", np.dstack([tinted(g), np.full_like(g, 9)])),
    "yuv422": lambda g: image("yuv422", interleaved(g, first=False)),
    "yuv422_yuy2": lambda g: image("yuv422_yuy2", interleaved(g, first=True)),
    "bayer 16": lambda g: image("bayer_grbg16", mosaic("grbg", tinted(g)).astype(np.uint16) * 4),
    **{
        order: lambda g, order=order: image(f"bayer_{order}8", mosaic(order, tinted(g)))
        for order in MOSAIC
    },
}


def compressed(words: str, kind: str, numbers: np.ndarray) -> CompressedImage:
    done, data = cv2.imencode(kind, numbers)
    assert done
    return CompressedImage(format=words, data=data.tobytes())


PACKED: dict[str, Callable[[np.ndarray], CompressedImage]] = {
    "jpeg": lambda g: compressed("mono8; jpeg compressed ", ".jpg", g),
    "jpeg of colour": lambda g: compressed("rgb8; jpeg compressed bgr8", ".jpg", tinted(g)),
    "png": lambda g: compressed("mono8; png compressed ", ".png", g),
    "png of 16 bits": lambda g: compressed(
        "mono16; png compressed ", ".png", g.astype(np.uint16) * 16
    ),
    "png of a mosaic": lambda g: compressed(
        "bayer_rggb8; png compressed ", ".png", mosaic("rggb", tinted(g))
    ),
    "jpeg of a Bayer camera": lambda g: compressed(
        "bayer_rggb8; jpeg compressed bgr8", ".jpg", tinted(g)
    ),
}


pictures = cache(pair)


def tip(read: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    left, right = pictures()
    return eye_for().measure(read(left), read(right)).point


@cache
def plain_tip() -> np.ndarray:
    return tip(lambda grey: grey)


@pytest.mark.parametrize("sent", SENT)
def test_the_tip_is_found_in_every_encoding(sent: str) -> None:
    off = tip(lambda grey: pixels_of(SENT[sent](grey))) - plain_tip()
    assert np.linalg.norm(off) < 2e-4
    if sent in ("mono16", "big-endian", "12 bits in mono16", "yuv422", "yuv422_yuy2"):
        assert not off.any()


@pytest.mark.parametrize("packed", PACKED)
def test_the_tip_is_found_in_compressed_images(packed: str) -> None:
    off = tip(lambda grey: decode(PACKED[packed](grey))) - plain_tip()
    assert np.linalg.norm(off) < 2e-4
    if packed in ("png", "png of 16 bits"):
        assert not off.any()


COLOURED = ("rgb8", "rgba8", "bgr8", "8UC3", "bgra8", "8UC4")
MOSAICS = tuple(f"bayer_{order}{bits}" for order in MOSAIC for bits in (8, 16))
GREY = ("mono8", "8UC1", "mono16", "16UC1", "yuv422", "uyvy", "yuv422_yuy2", "yuyv")


def test_these_are_all_encodings() -> None:
    assert {*COLOURED, *MOSAICS, *GREY} == set(ENCODINGS)


@pytest.mark.parametrize("encoding", [*COLOURED, *MOSAICS])
def test_red_is_not_blue(encoding: str) -> None:
    """A red surface is as bright as its brightness says, in every encoding with colours."""
    red = np.full((8, 12, 3), [20, 60, 200], np.uint8)  # blue, green, red
    luma = round(0.114 * 20 + 0.587 * 60 + 0.299 * 200)
    order = encoding.removeprefix("bayer_")[:4]
    if order in MOSAIC:
        wide = encoding.endswith("16")
        numbers = mosaic(order, red).astype(np.uint16) * 256 if wide else mosaic(order, red)
        seen = pixels_of(image(encoding, numbers))
        np.testing.assert_allclose(seen[2:-2, 2:-2], luma, atol=1)
    else:
        numbers = red[:, :, ::-1] if encoding.startswith("rgb") else red
        if "a8" in encoding or "4" in encoding:
            numbers = np.dstack([numbers, np.full((8, 12), 255, np.uint8)])
        np.testing.assert_array_equal(pixels_of(image(encoding, numbers)), red)


def test_what_is_no_image_is_refused_in_words() -> None:
    grey = np.zeros((4, 6), np.uint8)
    with pytest.raises(StereoRefusal, match="nv12"):
        pixels_of(image("nv12", grey))
    short = image("mono16", grey)  # half of the bytes that it says
    short.step = 6
    short.data = bytes(24)
    with pytest.raises(StereoRefusal, match="6x4, step 6, 24 bytes"):
        pixels_of(short)
    whole = PACKED["png"](grey).data.tobytes()
    for data in (b"", b"no image", whole[:20]):
        with pytest.raises(StereoRefusal, match=r"jpeg or png"):
            decode(CompressedImage(format="mono8; png compressed ", data=data))


def test_what_was_made_colour_before_it_was_packed_is_no_mosaic(rng: np.random.Generator) -> None:
    picture = rng.integers(0, 255, (8, 12, 3), dtype=np.uint8)
    plain, made = (
        decode(compressed(words, ".png", picture))
        for words in ("bgr8; png compressed bgr8", "bayer_rggb8; png compressed bgr8")
    )
    np.testing.assert_array_equal(plain, made)
