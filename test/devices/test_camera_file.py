"""Calibration files of cameras: as many coefficients as topics may have, and no fisheye."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from stereo_head import HEAD

from longarm_comp.core.errors import InputError
from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.camera_file import camera_text, read_camera

LENS = (-0.2, 0.05, 1e-4, -2e-4, 0.01, 0.3, -0.02, 4e-3)


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("plumb_bob", LENS[:4]),
        ("plumb_bob", LENS[:5]),
        ("rational_polynomial", LENS),
        ("rational_polynomial", (*LENS, 0.0, 0.0, 0.0, 0.0)),
        ("", ()),
    ],
)
def test_a_file_holds_what_a_topic_may_tell(
    model: str, d: tuple[float, ...], tmp_path: Path
) -> None:
    told = [dataclasses.replace(i, distortion_model=model, d=d) for i in HEAD.camera_infos()]
    files = [tmp_path / f"{side}.yaml" for side in ("left", "right")]
    for file, info in zip(files, told, strict=True):
        file.write_text(camera_text(file.stem, info))
    assert yaml.safe_load(files[0].read_text())["distortion_coefficients"]["cols"] == len(d)
    read = [read_camera(file) for file in files]
    assert read == told
    rigs = [StereoRig.from_camera_info(*pair, rectified=False) for pair in (read, told)]
    point = np.array([[0.1, -0.05, 0.8]])
    np.testing.assert_array_equal(*(rig.left.project(point)[0] for rig in rigs))


def test_a_fisheye_and_numbers_that_are_missing_are_refused(tmp_path: Path) -> None:
    file, (info, _) = tmp_path / "left.yaml", HEAD.camera_infos()
    fisheye = dataclasses.replace(info, distortion_model="equidistant")
    file.write_text(camera_text("left", fisheye))
    allowed = "'equidistant'; allowed: plumb_bob or rational_polynomial"
    with pytest.raises(InputError, match=rf"left\.yaml: distortion_model: {allowed}"):
        read_camera(file)
    file.write_text(camera_text("left", info))
    whole = yaml.safe_load(file.read_text())
    for key in ("distortion_coefficients", "camera_matrix"):
        file.write_text(yaml.safe_dump({k: v for k, v in whole.items() if k != key}))
        with pytest.raises(InputError, match=rf"{key}\.data: 'missing or no numbers'"):
            read_camera(file)
    file.write_text(yaml.safe_dump(whole | {"projection_matrix": {"data": [1.0] * 11}}))
    with pytest.raises(InputError, match=r"projection_matrix\.data: \[.*; allowed: 12 finite"):
        read_camera(file)
    for size in (0, -640, "wide"):
        file.write_text(yaml.safe_dump(whole | {"image_width": size}))
        with pytest.raises(InputError, match=r"image_width.*: \(.*; allowed: whole numbers"):
            read_camera(file)
