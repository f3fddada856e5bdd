"""Every effect that a model may hold, by its canonical name: one line each."""

from __future__ import annotations

from longarm_comp.core.effects.backlash import Backlash
from longarm_comp.core.effects.base_compliance import BaseCompliance
from longarm_comp.core.effects.base_pose import BasePose
from longarm_comp.core.effects.bearing_tilt import BearingTilt
from longarm_comp.core.effects.camera_drift import CameraDrift
from longarm_comp.core.effects.camera_pose import CameraPose
from longarm_comp.core.effects.camera_radial import CameraRadial
from longarm_comp.core.effects.camera_scale import CameraScale
from longarm_comp.core.effects.creep import Creep
from longarm_comp.core.effects.dh_error import DhError
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.friction_hysteresis import FrictionHysteresis
from longarm_comp.core.effects.gear_eccentricity import GearEccentricity
from longarm_comp.core.effects.gravity_direction import GravityDirection
from longarm_comp.core.effects.joint_compliance import JointCompliance
from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.effects.joint_zero import JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.link_stiffness import LinkStiffness
from longarm_comp.core.effects.measured_tilt import MeasuredTilt
from longarm_comp.core.effects.prismatic_pitch import PrismaticPitch
from longarm_comp.core.effects.servo_droop import ServoDroop
from longarm_comp.core.effects.servo_quantisation import ServoQuantisation
from longarm_comp.core.effects.telescope_clearance import TelescopeClearance
from longarm_comp.core.effects.thermal_growth import ThermalGrowth
from longarm_comp.core.effects.tip_offset import TipOffset
from longarm_comp.core.effects.tip_payload import TipPayload
from longarm_comp.core.errors import InputError

GEOMETRY: tuple[type[Effect] | type[Bias], ...] = (
    JointZero,
    DhError,
    BasePose,
    TipOffset,
    CameraPose,
)
DECLARED: tuple[type[Effect], ...] = (LinkDeflection,)
LIBRARY: tuple[type[Effect] | type[Bias], ...] = (
    JointCompliance,
    BearingTilt,
    LinkStiffness,
    TipPayload,
    TelescopeClearance,
    BaseCompliance,
    MeasuredTilt,
    GravityDirection,
    Backlash,
    FrictionHysteresis,
    GearEccentricity,
    JointGain,
    PrismaticPitch,
    ServoDroop,
    ServoQuantisation,
    ThermalGrowth,
    Creep,
    CameraScale,
    CameraRadial,
    CameraDrift,
)
BY_NAME: dict[str, type[Effect] | type[Bias]] = {
    kind.name: kind for kind in (*GEOMETRY, *DECLARED, *LIBRARY)
}


def effect_class(name: str, where: str) -> type[Effect] | type[Bias]:
    """The effect of a canonical name; `where` names the source in the error.

    Raises:
        InputError: no such effect.
    """
    try:
        return BY_NAME[name]
    except KeyError:
        raise InputError(where, "effect", name, ", ".join(sorted(BY_NAME))) from None
