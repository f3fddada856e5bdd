"""Camera calibrations as files, in the format of ROS camera drivers (``camera_info_url``)."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.devices.camera_info import CameraInfo
from longarm_comp.devices.stereo.camera import Camera, StereoRig, check_distortion
from longarm_comp.devices.stereo.target import Grey

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm"}


def pair_files(folder: Path) -> list[tuple[Path, Path]]:
    """List the left and right image files of a folder, in the order of their names.

    For instance ``left/3.png`` and ``right/3.png``, or ``left3.png`` and ``right3.png``. Raises
    InputError if there is no folder, no pair, or an image without its partner.
    """
    allowed = "a folder of images whose names have left and right in them, otherwise the same"
    if not folder.is_dir():
        raise InputError(folder, "images", "no folder", allowed)
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    images = [p for p in files if p.suffix.lower() in _SUFFIXES]
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
    """Read an image file as grey (H, W), uint8. Raises InputError if it cannot be read."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise InputError(path, "image", "cannot be read", "an image file of 8 bits a channel")
    return np.asarray(grey, dtype=np.uint8)


_MATRICES: dict[str, tuple[str, int, int | None]] = {
    "camera_matrix": ("k", 3, 3),
    "distortion_coefficients": ("d", 1, None),
    "rectification_matrix": ("r", 3, 3),
    "projection_matrix": ("p", 3, 4),
}
"""Field of `CameraInfo`, number of rows and of columns (None: any), by key in the file."""


def calibration_of(rig: StereoRig) -> tuple[CameraInfo, CameraInfo]:
    """Return the calibrations of a rig's left and right camera, with their rectification.

    The rig frame must be the raw left optical frame.
    """
    left, right = rig.left, rig.right
    cameras = (left.k, left.d[:5], right.k, right.d[:5], left.size)
    move = right.translation.reshape(3, 1)
    rectified = cv2.stereoRectify(*cameras, right.rotation, move, alpha=0.0)
    r_left, r_right, p_left, p_right = rectified[:4]

    def of(camera: Camera, r: Any, p: Any) -> CameraInfo:
        d, k, r, p = (tuple(np.ravel(a).tolist()) for a in (camera.d[:5], camera.k, r, p))
        width, height = camera.size
        return CameraInfo(width, height, "plumb_bob", d, k, r, p)

    return of(left, r_left, p_left), of(right, r_right, p_right)


def camera_text(name: str, camera: CameraInfo, head: str = "") -> str:
    """Return the text of a file with a camera's calibration; ``head``: comment at its top."""
    data: dict[str, Any] = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "distortion_model": camera.distortion_model,
    }
    for key, (field, rows, _) in _MATRICES.items():
        numbers = list(getattr(camera, field))
        data[key] = {"rows": rows, "cols": len(numbers) // rows, "data": numbers}
    comment = "".join(f"# {line}\n" for line in head.splitlines())
    return comment + yaml.safe_dump(data, sort_keys=False, default_flow_style=None)


def read_camera(path: Path) -> CameraInfo:
    """Read a camera's calibration. Raises InputError for an entry that is missing or wrong."""
    data = read_yaml(path)
    values: dict[str, tuple[float, ...]] = {}
    for key, (field, rows, columns) in _MATRICES.items():
        allowed = "finite numbers" if columns is None else f"{rows * columns} finite numbers"
        try:
            numbers = tuple(float(v) for v in data[key]["data"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(path, f"{key}.data", "missing or no numbers", allowed) from error
        count_fits = columns is None or len(numbers) == rows * columns
        if not (count_fits and np.isfinite(numbers).all()):
            raise InputError(path, f"{key}.data", list(numbers), allowed)
        values[field] = numbers
    sizes = data.get("image_width"), data.get("image_height")
    if not all(isinstance(size, int) and size > 0 for size in sizes):
        raise InputError(path, "image_width, image_height", sizes, "whole numbers of pixels")
    model = str(data.get("distortion_model"))
    check_distortion(model, path)
    width, height = sizes
    return CameraInfo(width, height, model, **values)
