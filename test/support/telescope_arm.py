"""A telescope on a luffing joint, declared without any weight, and the true arm beside it."""

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.model.model import Model

_TOLD = {
    "name": "telescope",
    "convention": "mdh_craig",
    "joints": [
        {"id": 1, "type": "revolute", "alpha_deg": 90, "d_m": 0.8, "limits_deg": [0, 60]},
        {"id": 2, "type": "prismatic", "alpha_deg": 90, "d_m": 3.2, "theta_offset_deg": 90,
         "limits_m": [0, 2.5]},
        {"id": 3, "type": "revolute", "alpha_deg": -90, "limits_deg": [-30, 30]},
    ],
    "tip": {"frame": 3, "position_m": [0.4, 0, 0]},
}  # fmt: skip
WEIGHTLESS = Arm.parse(_TOLD, "weightless")


def heavy(bending_nm2: float, compliance: float) -> Model:
    """The true arm: 120 kg that stay, 50 that slide, 20 at the tip; its first joint yields."""
    stiff = {"row": 2, "role": "d", "EI_nm2": bending_nm2, "GJ_nm2": 1e9}
    boom = [
        {"name": "outer", "length_m": 3.0, "mass_kg": 120, "body_length_m": 3.0, **stiff},
        {"name": "inner", "length_m": "rest", "mass_kg": 50, "body_length_m": 2.9, **stiff},
    ]
    load = {"mass_kg": 20, "frame": 3, "position_m": [0.4, 0, 0]}
    arm = Arm.parse(_TOLD | {"links": boom, "payload": load}, "heavy")
    return Model(arm, (LinkDeflection(), JointCompliance(1, compliance)))
