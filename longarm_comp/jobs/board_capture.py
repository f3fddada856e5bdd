"""Guided capture of a calibration board from the image topics."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from sensor_msgs.msg import Image

from longarm_comp.core.errors import InputError
from longarm_comp.devices.stereo.mounting import check_mounting
from longarm_comp.devices.stereo.pairing import Pair, Side, StereoPairer
from longarm_comp.devices.stereo.refusal import StereoRefusal
from longarm_comp.devices.stereo.target import Grey, Target
from longarm_comp.devices.stereo.views import FEWEST_VIEWS, BoardView, gaps, view_of
from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_ns
from longarm_comp.nodes.images import pixels_of

_PATIENCE_S = 600.0
"""With a person who holds the board; Ctrl-C ends it sooner."""


class _Images:
    """The newest pair of images on the topics."""

    def __init__(self, client: GraphClient) -> None:
        self._pairer: StereoPairer[Image] = StereoPairer()
        self._newest: Pair[Image] | None = None
        for side, topic in ((Side.LEFT, graph.LEFT_IMAGE), (Side.RIGHT, graph.RIGHT_IMAGE)):
            topic.subscription(client.node, partial(self._on, side))

    def _on(self, side: Side, message: Image) -> None:
        for pair in self._pairer.add(side, stamp_ns(message.header.stamp), message):
            self._newest = pair

    def take(self) -> tuple[Grey, Grey] | None:
        """The newest pair (H, W) uint8, once."""
        pair, self._newest = self._newest, None
        return None if pair is None else (_grey(pair.left), _grey(pair.right))


def capture(
    client: GraphClient,
    board: Target,
    tell: Callable[[str], None],
    *,
    save: Path | None = None,
) -> tuple[list[BoardView], tuple[int, int]]:
    """Take a view whenever the board rests somewhere new, until nothing is missing.

    Returns the views, and (width, height) px of the images, which go into the folder ``save``.
    """
    views: list[BoardView] = []
    before: BoardView | None = None
    size: tuple[int, int] | None = None
    images = _Images(client)

    def complete() -> bool:
        nonlocal before, size
        pair = images.take()
        if pair is None:
            return False
        found = pair[0].shape[1], pair[0].shape[0]
        if size not in (None, found):
            raise InputError("left/image_raw", "size", found, f"{size} as before")
        size = found
        try:
            view = view_of(board, *pair)
        except StereoRefusal as refusal:
            tell(refusal.reason.value)
            before = None
            return False
        rests, before = view.is_still(before), view
        if rests and view.is_new(views, size[0]):
            views.append(view)
            check_mounting(views)
            if save is not None:
                _save(save, len(views), pair)
        elif not rests:
            tell("hold the board still")
            return False
        lacking = gaps(views, size)
        tell(f"{len(views)} of {FEWEST_VIEWS} views; " + (lacking[-1] if lacking else "done"))
        return not lacking

    client.until(lambda: images.take() is not None, 30.0, "no pair of images")
    client.until(
        complete, _PATIENCE_S,
        lambda: f"not within {_PATIENCE_S:g} s, {len(views)} views: "
        + ("board" if size is None else "; ".join(gaps(views, size))),
    )  # fmt: skip
    assert size is not None
    return views, size


def _grey(message: Image) -> Grey:
    pixels = pixels_of(message)
    if pixels.ndim == 3:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    return np.ascontiguousarray(pixels)


def _save(folder: Path, number: int, pair: tuple[Grey, Grey]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for side, grey in zip(("left", "right"), pair, strict=True):
        if not cv2.imwrite(str(folder / f"{side}{number:02d}.png"), grey):
            raise InputError(folder, "--save", "cannot be written", "a folder to write in")
