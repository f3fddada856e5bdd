"""Webcams: what Linux tells of them, a picture through OpenCV, the lines for ROS."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from cli_shell import Shell

from longarm_comp.devices.stereo import webcams as cameras


@pytest.fixture
def system(tmp_path: Path) -> Path:
    """Two webcams of two devices each: pictures and other data."""
    for number, (name, index) in enumerate((("Left", 0), ("Left", 1), ("Right", 0), ("Right", 1))):
        entry = tmp_path / "sys" / f"video{number}"
        entry.mkdir(parents=True)
        (entry / "name").write_text(f"{name} cam\n")
        (entry / "index").write_text(f"{index}\n")
    return tmp_path / "sys"


def film(path: Path) -> str:
    """Something that OpenCV opens like a camera: dark at first."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for grey in (0, 0, 0, 0, 200):
        writer.write(np.full((48, 64, 3), grey, np.uint8))
    writer.release()
    return str(path)


def test_a_camera_is_listed_once_and_its_picture_is_exposed(
    shell: Shell, system: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = cameras.webcams(system)
    assert [(c.device, c.name) for c in found] == [
        ("/dev/video0", "Left cam"), ("/dev/video2", "Right cam")
    ]  # fmt: skip
    seen = [cameras.Webcam(film(shell.folder / f"{name}.avi"), name) for name in ("one", "two")]
    monkeypatch.setattr(cameras, "webcams", lambda: seen)
    assert shell("stereo", "webcams", "--frames", "pictures") == 0, shell.err
    assert cv2.imread("pictures/one.avi.png").mean() > 150
    left, right = (line for line in shell.out.splitlines() if line.startswith("ros2 run"))
    assert seen[0].device in left and "image_raw:=left/image_raw" in left
    assert seen[1].device in right and "camera_info:=right/camera_info" in right
    monkeypatch.setattr(cameras, "webcams", lambda: seen[:1])
    assert "two webcams are needed" in shell.refused("stereo", "webcams", code=3)
    gone = cameras.Webcam(str(shell.folder / "gone.avi"), "gone")
    monkeypatch.setattr(cameras, "webcams", lambda: [gone])
    said = shell.refused("stereo", "webcams", "--frames", "others", code=3)
    assert "gives no picture" in said and "group video" in said
