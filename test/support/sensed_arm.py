"""The small arm as it really stands, measured by sensors of every kind (poses, wires, rays)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import drives, geometry
from longarm_comp.sim.hidden.base import HiddenEffect

SIGMA, SIGMA_ROT = 2e-4, 4e-4
BODY = Rotation.from_rotvec([1.2, -0.4, 2.0])
"""How the tracked body sits on the tip."""
ANCHORS = {"left": (0.9, -0.6, 0.2), "right": (0.8, 0.9, 0.1), "top": (-0.2, 0.3, 1.4)}
CAMERAS = {
    "boom": ((0.3, -1.5, 0.4), (-80.0, 10.0, 5.0)),
    "wall": ((1.6, 0.2, 0.9), (20.0, -60.0, 90.0)),
}
"""Place (m) and roll, pitch, yaw (deg) of calibrated cameras."""
ZEROS = (geometry.JointZero(np.array([0.0, 0.006, 0.0, -0.004])),)
GAIN = (drives.JointGain(np.array([0.0, 0.02, 0.0, 0.0])),)


@dataclass(frozen=True)
class Sensed:
    """Rows of the true arm: joints (N, n), tip (N, 3) m and axes (N, 3, 3)."""

    q: np.ndarray
    xyz: np.ndarray
    axes: Rotation
    rng: np.random.Generator

    def __len__(self) -> int:
        return len(self.q)

    def position(self, sigma: float = SIGMA) -> np.ndarray:
        """(N, 3) m."""
        return self.xyz + sigma * self.rng.standard_normal((len(self), 3))

    def quaternion(self, sigma: float = SIGMA_ROT) -> np.ndarray:
        """(N, 4) x, y, z, w of the tracked body."""
        noise = Rotation.from_rotvec(sigma * self.rng.standard_normal((len(self), 3)))
        return np.asarray((noise * self.axes * BODY).as_quat())

    def distance(self, names: np.ndarray) -> np.ndarray:
        """(N, 1) m to the anchor of each row."""
        places = np.array([ANCHORS[name] for name in names])
        length = np.linalg.norm(self.xyz - places, axis=1, keepdims=True)
        return np.asarray(length + SIGMA * self.rng.standard_normal((len(self), 1)))

    def ray(self, names: np.ndarray) -> np.ndarray:
        """(N, 3) direction in the axes of the camera of each row, of any length."""
        made = np.empty((len(self), 3))
        for name, (place, turn) in CAMERAS.items():
            local = Rotation.from_euler("xyz", turn, degrees=True).inv().apply(self.xyz - place)
            local /= np.linalg.norm(local, axis=1, keepdims=True)
            made[names == name] = (
                2.0 * (local + SIGMA_ROT * self.rng.standard_normal((len(self), 3)))[names == name]
            )
        return made


def sensed(hidden: Sequence[HiddenEffect] = ZEROS, n: int = 100, seed: int = 1) -> Sensed:
    """Random poses of the small arm."""
    rng = np.random.default_rng(seed)
    q = ARM.lower + rng.random((n, ARM.n)) * (ARM.upper - ARM.lower)
    pose = TrueArm(ARM, hidden).pose(q)
    return Sensed(q, pose[:, :3, 3], Rotation.from_matrix(pose[:, :3, :3]), rng)


def only(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Readings of some rows, NaN in the others."""
    return np.where(rows[:, None], values, np.nan)


def nowhere(n: int) -> np.ndarray:
    """No position in n rows."""
    return np.full((n, 3), np.nan)


def miss(model: Model, hidden: Sequence[HiddenEffect] = ZEROS) -> float:
    """Mean distance (m) of the predicted from the true tip at fresh poses."""
    fresh = sensed(hidden, 200, seed=99)
    return float(np.linalg.norm(model.tip(fresh.q) - fresh.xyz, axis=1).mean())


def declared(**more: object) -> Arm:
    """The small arm with further declarations."""
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    return Arm.parse({**data, **more}, "sensed arm")


def read(rows: Sensed, **more: object) -> Session:
    """A session of rows; positions unless given."""
    given = {"xyz": rows.position()} | more
    return Session.record(rows.q, **given)  # type: ignore[arg-type]
