"""How well the cameras of a folder see the marker: rendered images through the real detector."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.arm_folder.head import View
from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.eye import StereoEye
from longarm_comp.devices.stereo.refusal import StereoRefusal
from longarm_comp.devices.stereo.target import TagBoard
from longarm_comp.sim.cameras import CameraPair, render, tag_plate
from longarm_comp.sim.plant import mount_plate


@dataclass(frozen=True)
class _Sight:
    """What came of poses spread over the joints' limits.

    Attributes:
        poses, found: poses looked at, and those at which the tip was measured.
        off_mm: median distance of the measured tip from the tip; NaN where none was measured.
        why: at most of the others it was not.
    """

    poses: int
    found: int
    off_mm: float
    why: str = ""

    @property
    def seen(self) -> float:
        """Share of the poses, 0 to 1."""
        return self.found / self.poses

    def __str__(self) -> str:
        said = f"{self.found} of {self.poses} poses"
        return f"{said}, at most others {self.why}" if self.why else said


def seen_from(
    arm: Arm, bridge: Mapping[str, Any], simulated: Mapping[str, Any], poses: int = 12
) -> _Sight:
    """Look at an arm without errors at poses spread over its limits."""
    head = CameraPair(
        tuple(simulated["camera.position"]), tuple(simulated["camera.axis"]),
        simulated["camera.baseline_m"], simulated["camera.focal_px"],
        (simulated["camera.width"], simulated["camera.height"]),
    )  # fmt: skip
    marker = {k: simulated[f"marker.{k}"] for k in ("tag_m", "gap_m", "columns", "rows")}
    plate, on_tip = tag_plate(**marker), mount_plate(simulated["marker.mounting"])
    hand_eye = quaternion.compute_pose(
        np.array(bridge["hand_eye.xyz"]), np.array(bridge["hand_eye.quaternion"])
    )
    rig = StereoRig.from_camera_info(*head.camera_infos(), rectified=False)
    eye = StereoEye(rig, TagBoard.of(bridge), hand_eye, bridge["tip_in_marker"])
    rng = np.random.default_rng(0)
    off, lost = [], []
    for tip in declared_model(arm).pose(sobol(arm, poses, 0).q):
        left, right = render(tip @ on_tip, plate, head, rng)
        try:
            off.append(np.linalg.norm(eye.measure(left, right).point - tip[:3, 3]))
        except StereoRefusal:
            lost.append(tip)
    why = View.of(bridge, simulated).unseen(np.array(lost)) if lost else []
    return _Sight(poses, len(off), 1e3 * float(np.median(off)) if off else np.nan, _mostly(why))


def _mostly(why: list[str]) -> str:
    """One of the most frequent kind, with its figures."""
    kinds = Counter(text.partition(":")[0] for text in why if text)
    most = kinds.most_common(1)[0][0] if kinds else None
    return next((text for text in why if most and text.startswith(most)), "")
