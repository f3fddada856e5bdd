"""Lists the webcams of this computer (Linux), and takes pictures with them."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from longarm_comp.core.errors import JobError

_SYSTEM = Path("/sys/class/video4linux")


@dataclass(frozen=True)
class Webcam:
    """A camera: its device, such as ``/dev/video0``, and the maker's name of it."""

    device: str
    name: str


def webcams(system: Path = _SYSTEM) -> list[Webcam]:
    """List the video devices that give pictures. Other devices of a camera give other data."""
    found = []
    for entry in sorted(system.glob("video*"), key=lambda path: int(path.name[5:] or 0)):
        index = entry / "index"
        if not index.is_file() or index.read_text().strip() == "0":
            found.append(Webcam(f"/dev/{entry.name}", (entry / "name").read_text().strip()))
    return found


def picture(device: str) -> np.ndarray:
    """Take a picture (H, W, 3), BGR, with a video device.

    Raises:
        JobError: the device gives no picture.
    """
    camera = cv2.VideoCapture(device)
    try:
        # The first pictures of a webcam are dark: it sets its exposure
        taken = [image for _ in range(5) for ok, image in [camera.read()] if ok]
    finally:
        camera.release()
    if not taken:
        raise JobError(
            "the camera gives no picture: does another program use it, and are you in the group "
            "video (`sudo usermod -aG video $USER`)?",
            device=device,
        )
    return np.asarray(taken[-1])


def write_driver_commands(left: str, right: str) -> list[str]:
    """Return the shell commands that publish two cameras on the topics of `stereo_bridge`."""
    return [
        f"ros2 run v4l2_camera v4l2_camera_node --ros-args -p video_device:={device} "
        f"-r image_raw:={side}/image_raw -r camera_info:={side}/camera_info "
        f"-r __node:={side}_camera"
        for side, device in (("left", left), ("right", right))
    ]
