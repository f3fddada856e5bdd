"""Places the bases, markers and sensors of a model before anything is fitted."""

from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.noise import number_sightings
from longarm_comp.core.calibration.placement import (
    choose_reference_rows,
    place_bases,
    place_sensors,
    sensor_terms,
)
from longarm_comp.core.data.measurement import (
    compute_posture,
    compute_tip_errors,
    compute_turn_errors,
    make_equations,
)
from longarm_comp.core.data.registration import median_distance, median_spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.geometry_errors import ELSEWHERE
from longarm_comp.core.effects.placements import BasePose, TipOffset, TipOrientation
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.tip_motion import stack

TWICE = 2
"""Smallest ratio of measured values to placement parameters.

With fewer values, the residuals after the placement do not show the errors of the arm.
"""


def placement_terms(arm: Arm, session: Session) -> tuple[Effect | Bias, ...]:
    """Return the placement terms of a session: those of bases, markers and sensors.

    Base placements are left out if no sensor has a frame of its own.
    """
    groups = sorted(set(session.labels["group"])) if "group" in session.labels else []
    bases = tuple(BasePose(group=str(g)) for g in groups) if len(groups) > 1 else (BasePose(),)
    placed = bases if session.has_own_frame(arm) else ()
    return (*placed, *TipOffset.for_arm(arm), *sensor_terms(arm, session))


def place_frames(model: Model, session: Session) -> Model:
    """Return the model with bases, markers and sensors placed by the rows, without a fit."""
    whole = model.with_missing(placement_terms(model.arm, session))
    return place_sensors(place_bases(whole, choose_reference_rows(session)), session)


class SeenModel(NamedTuple):
    """A model, ready to be compared with the rows of a session.

    Attributes:
        elsewhere: whether the rows show the arm at another place than the given model.
        placed: whether this model was moved to that place.
    """

    model: Model
    elsewhere: bool
    placed: bool


def place_as_seen(model: Model, session: Session) -> SeenModel:
    """Place a model by the rows, if these show it at another place and hold enough measured values.

    There must be at least `TWICE` as many values as placement parameters that they determine. With
    fewer, the placement would fit the rows of any arm. Repeats of a sighting count once. The
    parameters of touched points are subtracted from both counts. The rotation of a tracked body on
    the tip is never declared, so it is always solved.
    """
    bodies = [t for t in placement_terms(model.arm, session) if isinstance(t, TipOrientation)]
    whole = model.with_missing(bodies)
    axes = model if whole.terms == model.terms else place_sensors(whole, session)
    groups = (session.take(session.frames == name) for name in np.unique(session.frames))
    if not any(is_misplaced(axes, rows) for rows in groups):
        return SeenModel(axes, elsewhere=False, placed=False)
    moved, seen = place_frames(model, session), session.take(session.seen)
    rows = seen.take(np.unique(number_sightings(seen), axis=0, return_index=True)[1])
    slots = [slot for slot in moved.slots if slot.parameter.unknown]
    found = make_equations(moved, rows, slots)
    columns = (found.columns * [slot.parameter.width for slot in slots]).reshape(-1, len(slots))
    passing = columns[:, [slot.owner.passing for slot in slots]]
    placing, points = (int(np.linalg.matrix_rank(each, rtol=1e-6)) for each in (columns, passing))
    more = int(rows.measured.sum()) - points >= TWICE * (placing - points)
    return SeenModel(moved if more else axes, elsewhere=True, placed=more)


def is_misplaced(model: Model, session: Session) -> bool:
    """Tell whether the rows show the arm at another place than the model.

    That is so if the median error exceeds `ELSEWHERE` times the spread of that frame of the arm
    which moves most. (The tip may hardly move, because it touches one point in all rows.) If only
    orientations were measured, the limit is `ELSEWHERE` in rad.
    """
    if not session.placed.any():
        return (
            bool(session.has_orientation.any())
            and median_distance(compute_turn_errors(model, session)) > ELSEWHERE
        )
    rows = session.take(session.placed)
    at = compute_posture(model, rows)
    frames = [stack(frame.p) for frame in (*at.frames, model.tip_frame(at))]
    travel = max(median_spread(p) for p in frames if p.ndim == 2)
    return median_distance(compute_tip_errors(model, rows)) > ELSEWHERE * travel
