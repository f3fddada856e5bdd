"""Pairs of image files: wherever a name has ``left`` in it, its partner has ``right``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.devices.stereo.target import Grey

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm"}


def pair_files(folder: Path) -> list[tuple[Path, Path]]:
    """Left and right files of a folder, in the order of their names.

    For instance ``left/3.png`` and ``right/3.png``, or ``left3.png`` and ``right3.png``.
    """
    allowed = "a folder of images whose names have left and right in them, otherwise the same"
    if not folder.is_dir():
        raise InputError(folder, "images", "no folder", allowed)
    images = [p for p in sorted(folder.rglob("*")) if p.suffix.lower() in _SUFFIXES]
    names = {p.relative_to(folder).as_posix(): p for p in images}
    pairs = []
    for name, path in names.items():
        for side, other in (("left", "right"), ("right", "left")):
            partner = name.replace(side, other)
            if side in name and partner not in names:
                raise InputError(folder, name, f"no {other} image", partner)
        if "left" in name:
            pairs.append((path, names[name.replace("left", "right")]))
    if not pairs:
        raise InputError(folder, "images", f"{len(images)} without a pair", allowed)
    return pairs


def read_grey(path: Path) -> Grey:
    """An image file as (H, W) uint8. Raises InputError where it cannot be read."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise InputError(path, "image", "cannot be read", "an image file of 8 bits a channel")
    return np.asarray(grey, dtype=np.uint8)
