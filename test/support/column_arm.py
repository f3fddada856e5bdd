"""A four-joint arm on a telescoping column, for whose slide no beam and no guide is declared."""

from typing import Any

from longarm_comp.core.arm.arm import Arm

EI = 2.0e4
COLUMN: dict[str, Any] = {
    "name": "column",
    "convention": "mdh_craig",
    "joints": [
        {"id": 1, "type": "prismatic", "d_m": 0.4, "limits_m": [0.0, 1.2]},
        {"id": 2, "type": "revolute", "limits_deg": [-150, 150]},
        {"id": 3, "type": "revolute", "a_m": 0.8, "limits_deg": [-150, 150]},
        {"id": 4, "type": "revolute", "alpha_deg": 90, "a_m": 0.6, "limits_deg": [-80, 80]},
    ],
    "tip": {"frame": 4, "position_m": [0.5, 0.02, 0.03]},
    "point_masses": [
        {"name": "upper", "frame": 2, "mass_kg": 4.0, "position_m": [0.4, 0, 0]},
        {"name": "lower", "frame": 4, "mass_kg": 3.0, "position_m": [0.2, 0, 0]},
    ],
    "gravity_mps2": [0, 0, -9.81],
    "camera": {"position_m": [0.5, -3.0, 1.0]},
}
BENT = {"name": "column", "row": 1, "role": "d", "length_m": "rest", "EI_nm2": EI, "GJ_nm2": 1e9}


def arm(*beams: dict[str, Any]) -> Arm:
    return Arm.parse(COLUMN | {"links": list(beams)}, "test")
