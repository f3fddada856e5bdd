"""A four-joint arm and sessions measured on it, for tests of files and checks (rigid, exact)."""

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.placements import BasePose
from longarm_comp.core.model.model import Model

ARM = Arm.parse(
    {
        "name": "small",
        "convention": "mdh_craig",
        "tip": {"frame": 4, "position_m": [0.0, 0.02, 0.05]},
        "joints": [
            {"id": 1, "type": "revolute", "d_m": 0.1, "limits_deg": [-40, 40]},
            {"id": 2, "type": "revolute", "alpha_deg": 90, "a_m": 0.05, "limits_deg": [10, 70]},
            {"id": 3, "type": "prismatic", "alpha_deg": 90, "d_m": 0.4, "limits_m": [0, 0.1]},
            {"id": 4, "type": "revolute", "alpha_deg": -90, "a_m": 0.1, "limits_deg": [-30, 60]},
        ],
    },
    "small arm",
)

AWAY = BasePose(x=2.0, y=-1.0, z=0.5, rx=0.1, ry=0.2, rz=1.1)
"""Far from where its base is declared."""


def measured(n: int, rng: np.random.Generator, **more: object) -> Session:
    """n random poses of the small arm, its rigid tip with 0.1 mm of noise."""
    q = ARM.lower + rng.random((n, ARM.n)) * (ARM.upper - ARM.lower)
    xyz = Model(ARM).tip(q) + 1e-4 * rng.standard_normal((n, 3))
    return Session.record(q, xyz, **more)  # type: ignore[arg-type]
