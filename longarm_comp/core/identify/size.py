"""Whether the rows tell how large the arm is.

A tip that only ever touched unknown points looks the same on an arm twice as large.  The size is
then that of the drawing.  It takes a known distance between two points, or a slide's travel.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.measurement import equations, posture
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.model.model import Model

_STEP = 1e-4
"""Share by which the arm is made larger, to see what changes."""


def size_told(fit: ModelFit) -> bool:
    """Whether the rows say more of the arm's size than the tolerances of its drawing do."""
    larger = _larger(fit.model, 1.0 + _STEP)
    seen = equations(larger, fit.session, posture(larger, fit.session), ()).residual
    change = fit.whitened((seen - fit.residual)[..., None] / _STEP)[:, 0]
    passing = fit.design[:, [slot.owner.passing for slot in fit.slots]]
    gram = np.eye(passing.shape[1]) + passing.T @ passing
    taken = passing.T @ change
    told = float(change @ change - taken @ np.linalg.solve(gram, taken))
    return told > _by_drawing(fit)


def _by_drawing(fit: ModelFit) -> float:
    """Information of the drawing's tolerances about the size: sum of (length / tolerance)^2."""
    total = 0.0
    for slot in fit.slots:
        if slot.owner.geometry and slot.parameter.unit == "m" and "row" in slot.owner.places:
            joint = fit.model.arm.joints[slot.owner.places["row"] - 1]
            length = getattr(joint, f"{slot.parameter.name}_m", 0.0)
            total += (length / slot.parameter.width) ** 2
    return total


def _larger(model: Model, times: float) -> Model:
    """The model with every length of its geometry multiplied; known distances are not."""
    values = model.values.copy()
    for k, slot in enumerate(model.slots):
        if slot.owner.geometry and slot.parameter.unit == "m" and slot.parameter.name != "stretch":
            values[k] *= times
    return dataclasses.replace(model.with_values(values), arm=_grown(model.arm, times))


def _grown(arm: Arm, times: float) -> Arm:
    def by(xyz: tuple[float, float, float]) -> tuple[float, float, float]:
        return (times * xyz[0], times * xyz[1], times * xyz[2])

    joints = []
    for joint in arm.joints:
        pose = joint.pose and joint.pose.model_copy(update={"xyz_m": by(joint.pose.xyz_m)})
        sizes = {"a_m": times * joint.a_m, "d_m": times * joint.d_m, "pose": pose}
        joints.append(joint.model_copy(update=sizes))
    tip = arm.tip.model_copy(update={"position_m": by(arm.tip.position_m)})
    markers = {
        name: marker.model_copy(update={"position_m": by(marker.position_m)})
        for name, marker in arm.markers.items()
    }
    return arm.model_copy(update={"joints": tuple(joints), "tip": tip, "markers": markers})
