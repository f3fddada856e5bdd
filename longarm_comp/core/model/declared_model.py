"""The model of an arm before any measurement."""

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.drive_errors import ServoQuantisation
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.model.model import Model


def declared_model(arm: Arm, *, deflection: bool = True) -> Model:
    """Return the model of the declared arm, which has not been fitted.

    It holds the rounding to servo steps and, if ``deflection`` is set, the deflection of the beams.
    """
    sag = (LinkDeflection(),) if deflection and arm.links else ()
    stepped = [row for row in arm.commanded if arm.joints[row - 1].step > 0]
    return Model(arm, (*sag, *(ServoQuantisation(row, steps_per_turn=0) for row in stepped)))
