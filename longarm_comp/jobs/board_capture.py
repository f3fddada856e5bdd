"""Guided capture of a calibration board from the image topics."""

from collections import deque
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
from longarm_comp.devices.stereo.views import FEWEST_VIEWS, BoardView, find_view, list_gaps
from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_ns
from longarm_comp.nodes.images import pixels_of

_PATIENCE_S = 600.0
"""Longest wait (s) for a person who holds the board; Ctrl-C ends it sooner."""


def capture(
    client: GraphClient, board: Target, tell: Callable[[str], None], *, save: Path | None = None
) -> tuple[list[BoardView], tuple[int, int]]:
    """Take a view whenever the board rests at a new place, until all needed views are there.

    Args:
        tell: called with what the person should do next.
        save: folder to write the images to, if given.

    Returns:
        The views, and width and height of the images, px.

    Raises:
        JobError: no pair of images came within 30 s, views are lacking after 600 s, or the cameras
            are mounted wrongly (`check_mounting`).
    """
    views: list[BoardView] = []
    before: BoardView | None = None
    size: tuple[int, int] | None = None
    pairer: StereoPairer[Image] = StereoPairer()
    newest: deque[Pair[Image]] = deque(maxlen=1)

    def hear(side: Side, message: Image) -> None:
        newest.extend(pairer.add(side, stamp_ns(message.header.stamp), message))

    for side, topic in ((Side.LEFT, graph.LEFT_IMAGE), (Side.RIGHT, graph.RIGHT_IMAGE)):
        topic.subscription(client.node, partial(hear, side))

    def complete() -> bool:
        nonlocal before, size
        if not newest:
            return False
        images = newest.pop()
        pair = _to_grey(images.left), _to_grey(images.right)
        found = pair[0].shape[1], pair[0].shape[0]
        if size not in (None, found):
            raise InputError("left/image_raw", "size", found, f"{size} as before")
        size = found
        try:
            view = find_view(board, *pair)
        except StereoRefusal as refusal:
            tell(refusal.reason.value)
            before = None
            return False
        rests, before = view.is_still(before), view
        if rests and view.is_new(views, size[0]):
            views.append(view)
            check_mounting(views)
            if save is not None:
                save.mkdir(parents=True, exist_ok=True)
                for name, grey in zip(("left", "right"), pair, strict=True):
                    if not cv2.imwrite(f"{save}/{name}{len(views):02d}.png", grey):
                        allowed = "a folder to write in"
                        raise InputError(save, "--save", "cannot be written", allowed)
        elif not rests:
            tell("hold the board still")
            return False
        gaps = list_gaps(views, size)
        tell(f"{len(views)} of {FEWEST_VIEWS} views; {gaps[-1] if gaps else 'done'}")
        return not gaps

    def lacking() -> str:
        missing = "board" if size is None else "; ".join(list_gaps(views, size))
        return f"not within {_PATIENCE_S:g} s, {len(views)} views: {missing}"

    client.until(lambda: newest, 30.0, "no pair of images")
    client.until(complete, _PATIENCE_S, lacking)
    assert size is not None
    return views, size


def _to_grey(message: Image) -> Grey:
    pixels = pixels_of(message)
    if pixels.ndim == 3:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    return np.ascontiguousarray(pixels)
