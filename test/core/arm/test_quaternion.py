"""Quaternions against SciPy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm import quaternion

TURNS = Rotation.random(40, random_state=4)
HALF_TURNS = Rotation.from_rotvec(np.pi * np.eye(3))


@pytest.mark.parametrize("turn", [*TURNS, *HALF_TURNS, Rotation.identity()])
def test_matrix_and_back(turn: Rotation) -> None:
    q = turn.as_quat()
    pose = quaternion.compute_pose(np.array([1.0, 2.0, 3.0]), q)
    np.testing.assert_allclose(pose[:3, :3], turn.as_matrix(), atol=1e-12)
    assert pose[:, 3].tolist() == [1, 2, 3, 1] and pose[3, :3].tolist() == [0, 0, 0]
    back = quaternion.from_rotation(turn.as_matrix())
    assert back[3] >= 0
    np.testing.assert_allclose(np.abs(back @ q), 1.0, atol=1e-12)


@pytest.mark.parametrize("turn", list(TURNS[:10]))
def test_tilt_is_roll_and_pitch(turn: Rotation) -> None:
    roll, pitch, _ = turn.as_euler("xyz")
    np.testing.assert_allclose(quaternion.compute_tilt(turn.as_quat()), (roll, pitch), atol=1e-9)


def test_what_is_a_unit_quaternion() -> None:
    assert quaternion.is_unit(np.array([0.0, 0.0, 0.7071, 0.7071]))
    assert not quaternion.is_unit(np.array([0.0, 0.0, 0.0, 1.01]))
    assert not quaternion.is_unit(np.zeros(4))
    assert not quaternion.is_unit(np.array([np.nan, 0, 0, 1]))
    assert not quaternion.is_unit(np.array([np.inf, 0, 0, 1]))
