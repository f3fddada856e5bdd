"""A beam along the negative direction of its axis bends as the same beam along the positive one."""

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model

AT_FRAME = {"position_m": [0.0, 0.0, 0.0]}


def boom(sign: int) -> Arm:
    turning = {"type": "revolute", "limits_deg": [-10, 10]}
    beam = {"name": "boom", "row": 1, "role": "d", "length_m": 2.0, "mass_kg": 5.0}
    return Arm.parse(
        {
            "name": "boom",
            "convention": "mdh_craig",
            "joints": [{"id": 1, **turning, "alpha_deg": 90 * sign, "d_m": 2.0 * sign}],
            "links": [{**beam, "EI_nm2": 1e4, "GJ_nm2": 1e4}],
            "point_masses": [{"name": "hand", "frame": 1, "mass_kg": 3.0, **AT_FRAME}],
            "tip": {"frame": 1},
        },
        "boom",
    )


def test_a_beam_may_point_against_its_axis() -> None:
    q = np.zeros((1, 1))
    along, against = (declared_model(boom(sign)).tip(q)[0] for sign in (1, -1))
    rigid = Model(boom(-1)).tip(q)[0]
    assert rigid[2] - against[2] > 1e-3
    np.testing.assert_allclose(against, along, atol=1e-12)
