"""The model of an arm before any measurement."""

from __future__ import annotations

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.model.model import Model


def declared_model(arm: Arm, *, deflection: bool = True) -> Model:
    """The arm as declared, with the sag of its beams if ``deflection`` is set."""
    return Model(arm, (LinkDeflection(),) if deflection and arm.links else ())
