"""What one arm's elasticity says of its twin: DLR Justin's right arm, then few rows of its left.

Right and left are drawn alike, so what gives way at the right is what is expected of the left:
torsion of the joints and lateral elasticity of their seats, each with one free amount.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from longarm_comp.core.calibration.calibrate import geometry
from longarm_comp.core.calibration.fit import fit
from longarm_comp.core.calibration.placement import place_bases
from longarm_comp.core.data.measurement import errors
from longarm_comp.core.effects.compliances import BearingTilt, JointCompliance
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import KindDirection
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from studies.real_sessions import Measured, justin

COUNTS, DRAWS = (20, 40, 80), 3
"""Rows of the left arm, and how often they are drawn."""
_BENDS: tuple[type[Effect], ...] = (JointCompliance, BearingTilt)


def study(
    folder: Path, counts: tuple[int, ...], draws: int, say: Callable[[str], None]
) -> Iterator[dict[str, object]]:
    """One row a count: mean error (mm) at the left arm's test poses, with the sd of the draws.

    rigid: geometry alone; own: each compliance of the left, within the drawing's tolerances;
    right: the right arm's, as one amount of torsion and one of lateral elasticity.
    """
    right, left = justin(folder)
    say("right arm")
    bends = [kind.for_arm(right.arm) for kind in _BENDS]
    whole = fit(_rigid(right).plus(*(t for each in bends for t in each)), right.train).model
    shared = tuple(
        KindDirection(number, tuple(e for e in whole.effects if isinstance(e, kind)))
        for number, kind in enumerate(_BENDS, 1)
    )
    own = tuple(t for kind in _BENDS for t in kind.for_arm(left.arm))
    for count in counts:
        found: dict[str, list[float]] = {}
        for draw in range(draws):
            say(f"{count} rows of the left arm, {draw + 1} of {draws}")
            rows = np.random.default_rng([count, draw]).permutation(len(left.train))[:count]
            few = Measured(left.arm, left.train.take(np.sort(rows)), left.test)
            for name, terms in {"rigid": (), "own": own, "right": shared}.items():
                model = fit(_rigid(few).plus(*terms), few.train).model
                length = np.linalg.norm(errors(model, few.held_out), axis=1)
                found.setdefault(name, []).append(1e3 * float(length.mean()))
        row: dict[str, object] = {"rows": count}
        for name, values in found.items():
            row[f"{name}_mm"] = round(float(np.mean(values)), 2)
            row[f"{name}_sd_mm"] = round(float(np.std(values)), 2)
        yield row


def _rigid(part: Measured) -> Model:
    model = declared_model(part.arm, deflection=False).plus(*geometry(part.arm, part.train))
    return place_bases(model, part.train)
