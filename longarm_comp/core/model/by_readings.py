"""The arm by the readings of its joints: where the tip is, whatever the servos made of a command.

What acts before the encoders is in the readings, and so left out.  A driver that trims brings the
readings to the commands: then this is the model of the commands.
"""

from __future__ import annotations

import dataclasses

from longarm_comp.core.effects.encoder import Encoder, Shaft
from longarm_comp.core.model.encoders import sees
from longarm_comp.core.model.model import Model


def by_readings(model: Model) -> Model:
    """The model whose joints are readings (rad, m) instead of commands."""
    arm = model.arm
    behind = [e for e in model.effects if not any(sees(arm, row, e) for row in arm.commanded)]
    encoders = [b for b in model.biases if isinstance(b, Encoder)]
    shafts = [Shaft(e.joint, e.zero, e.scale) for e in encoders]
    return dataclasses.replace(
        model,
        effects=(*behind, *shafts),
        biases=tuple(b for b in model.biases if not isinstance(b, Encoder)),
    )
