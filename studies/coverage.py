"""How often a measured row lies inside the 90 % radius that its model states.

The radius is of a measured row: error of the tip and noise of the measurement.  Rows are left out
three ways: the splits of the public data (off the grid, or at random), places (an eighth of the
joint space, refitted without it), and fresh random poses of simulated arms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.measurement import equations, errors, posture
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.bearing_tilt import BearingTilt
from longarm_comp.core.effects.catalogue import effect_class
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.joint_compliance import JointCompliance
from longarm_comp.core.identify.calibrate import stages
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.uncertainty import uncertainty
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.uncertainty import sizes
from studies.loop_cases import Case
from studies.loop_setting import set_up
from studies.real_sessions import Measured, justin, laser_tracked

HALVED = 3
"""Joints whose range is halved: eight places, left out one at a time."""
ROWS = 300
SIMULATED = ("joint_compliance", "backlash", "joint_gain", "link_stiffness")
"""Effects of the simulated arms in turn: half of the arms know them, half do not."""

Terms = Callable[[Arm], tuple[Effect | Bias, ...]]
Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class LeftOutRows:
    """Rows left out of a fit, against what it states of them.

    Attributes:
        set: robot, and how the rows were left out.
        error: (N,) m, measured - predicted.
        expected, radius: (N,) m, of a measured row.
    """

    set: str
    error: np.ndarray
    expected: np.ndarray
    radius: np.ndarray


def judge(name: str, fitted: ModelFit, rows: Session) -> LeftOutRows:
    """Hold rows with a position against a fit that has not seen them."""
    known, seen = uncertainty(fitted), rows.take(rows.located)
    model = fitted.model
    columns = equations(model, seen, posture(model, seen)).columns[:, :3]
    carried = known.carried(columns, [slot.identity for slot in fitted.slots])
    expected, radius = sizes(carried + known.structure + known.noise)
    return LeftOutRows(name, np.linalg.norm(errors(model, seen), axis=1), expected, radius)


def real(folder: Path, say: Progress = lambda _: None) -> Iterator[LeftOutRows]:
    """The public data sets: their own splits, and places.

    Args:
        folder: holds ``dlr_justin`` and ``wam_ur5``.
        say: called with each set.

    Raises:
        InputError: a data set is missing.
    """
    robots: dict[str, tuple[list[Measured], Terms]] = {
        "dlr_justin": (justin(folder), _bends),
        "wam": (laser_tracked(folder, "wam"), _rigid),
        "ur5": (laser_tracked(folder, "ur5"), _rigid),
    }
    for robot, (parts, terms) in robots.items():
        for part in parts:
            say(f"{robot}: its own split")
            yield judge(f"{robot}, its own split", _fitted(part.arm, part.train, terms), part.test)
            for kept, out in _places(part.train):
                say(f"{robot}: places")
                yield judge(f"{robot}, places", _fitted(part.arm, kept, terms), out)


def simulated(declared: Arm, count: int, say: Progress = lambda _: None) -> Iterator[LeftOutRows]:
    """Random arms with a hidden effect that every other model knows; fresh random poses."""
    for k in range(count):
        name = SIMULATED[k % len(SIMULATED)]
        say(f"arm {k + 1}: {name}")
        setting = set_up(
            Case("single", (name,), False, "usual", "sobol", ROWS, 1.0, k, 0), declared
        )
        told = (k // len(SIMULATED) + k) % 2 == 0
        kind = effect_class(name, "study coverage")
        fitted = _fitted(setting.arm, setting.train, kind.for_arm if told else _rigid)
        how = "the effect known" if told else "the effect not known"
        yield judge(f"simulated, {how}", fitted, setting.held_out)


def table(found: Sequence[LeftOutRows]) -> list[dict[str, object]]:
    """One row a set."""
    rows: list[dict[str, object]] = []
    for name in dict.fromkeys(each.set for each in found):
        mine = [each for each in found if each.set == name]
        error, expected, radius = (
            np.concatenate([getattr(each, k) for each in mine])
            for k in ("error", "expected", "radius")
        )
        rows.append(
            {
                "set": name,
                "rows": len(error),
                "inside_90": float((error <= radius).mean()),
                "mean_mm": 1e3 * float(error.mean()),
                "expected_mm": 1e3 * float(expected.mean()),
                "p90_mm": 1e3 * float(radius.mean()),
            }
        )
    return rows


def _fitted(arm: Arm, rows: Session, terms: Terms) -> ModelFit:
    """Geometry, then further terms on top of it."""
    *_, (_, geometry) = stages(declared_model(arm), rows)
    more = terms(arm)
    return fit(geometry.model.plus(*more), rows) if more else geometry


def _rigid(arm: Arm) -> tuple[Effect | Bias, ...]:
    return ()


def _bends(arm: Arm) -> tuple[Effect | Bias, ...]:
    return (*JointCompliance.for_arm(arm), *BearingTilt.for_arm(arm))


def _places(rows: Session) -> Iterator[tuple[Session, Session]]:
    """Rows without and with each place: halves of the joints that moved farthest, crossed."""
    place = np.zeros(len(rows), dtype=int)
    for j in np.argsort(-np.ptp(rows.q, axis=0))[:HALVED]:
        place = 2 * place + (rows.q[:, j] > np.median(rows.q[:, j]))
    for each in np.unique(place):
        yield rows.take(place != each), rows.take(place == each)
