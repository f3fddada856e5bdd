"""Places bases, markers, sensors, anchors and touched points by the measurements, before a fit.

A placement is never a finding.  Its start is computed here in closed form.  Then `fit_model` fits
it with all other parameters, with priors so wide that they have no influence
(`Parameter.unknown`).
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data import touched
from longarm_comp.core.data.kinds import KINDS, compute_rotations
from longarm_comp.core.data.lifted_base import lifted_base, multilaterate
from longarm_comp.core.data.measurement import compute_posture, compute_tip_errors
from longarm_comp.core.data.registration import Sightings, median_distance, register
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.geometry_errors import Encoder
from longarm_comp.core.effects.placements import (
    AnchorPlace,
    BasePose,
    SensorPlace,
    TipOffset,
    TipOrientation,
)
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model, slots_of
from longarm_comp.math.points import ROUNDS, robust_kabsch, robust_weights

CLEARLY = 2.0
"""Ratio of errors from which the computed placement replaces the one that the model has."""
ENOUGH = 4
"""Smallest number of rows with a whole position for the registration of bases and markers."""
BEYOND, ROUGHLY = 10.0, 0.2
"""Largest deviation of a known base: `BEYOND` standard deviations plus `ROUGHLY` (m or rad).

The second part allows for errors of the registration.
"""


def place_bases(model: Model, session: Session) -> Model:
    """Return the model with its unknown bases and markers placed by the sightings.

    With fewer than `ENOUGH` whole positions, the bases are placed by the other measurements, and
    the markers are not changed.  The model is also not changed if it fits well already (`CLEARLY`).

    Args:
        model: holds a `base_pose` per group and the markers' `tip_offset`.

    Raises:
        InputError: a base is far beyond its declared tolerance.
    """
    seen = session.take(session.has_position)
    frames = [e for e in model.effects if isinstance(e, BasePose | TipOffset)]
    tips = any(isinstance(e, TipOffset) and _is_unknown(model, e) for e in frames)
    frames = [e for e in frames if isinstance(e, BasePose) or tips]
    if not frames:
        return model
    if len(seen) < ENOUGH:
        return _lift_bases(model, session)
    markers = sorted({e.marker for e in frames if isinstance(e, TipOffset)}) or [""]
    groups = sorted({e.group for e in frames if isinstance(e, BasePose)}) or [""]
    rows = Sightings.of(model.without({e.key for e in frames}), seen, groups, markers)
    found = register(rows, tips)
    now = np.linalg.norm(seen.xyz - model.measured(seen.q, seen.context()), axis=1)
    alike = [rows.group + len(groups) * rows.marker == k for k in range(len(groups) * len(markers))]
    if all(np.median(now[mine]) <= CLEARLY * found.misfit for mine in alike if mine.any()):
        return model
    for effect in frames:
        if isinstance(effect, BasePose):
            g = groups.index(effect.group)
            solved = _move_base(effect, found.rotation[g], found.offset[g], model)
            if not _is_unknown(model, effect):
                for p in effect.parameters(model.arm):
                    away = abs(getattr(solved, p.name) - getattr(effect, p.name))
                    if away > BEYOND * p.width + ROUGHLY:
                        raise InputError(
                            session.source,
                            effect.where,
                            f"{p.name} {away:.3g} {p.unit} off",
                            f"within tolerance.base of arm.yaml, {p.name} {p.width:.3g} {p.unit}; "
                            "leave no tolerance, if the base may stand anywhere",
                        )
                continue
        elif _is_unknown(model, effect):
            at = found.tip[markers.index(effect.marker)]
            solved = effect.with_values(dict(zip("xyz", at, strict=True)))
        else:
            continue
        model = _replace_term(model, effect, solved)
    return model


def _lift_bases(model: Model, session: Session) -> Model:
    """Return the model with unknown bases placed by coordinates, distances, rays, orientations.

    A base is not changed unless this fits much better (`CLEARLY`).
    """
    for effect in model.effects:
        if not (isinstance(effect, BasePose) and _is_unknown(model, effect)):
            continue
        rows = session.where("group", effect.group) if effect.group else session
        rows = rows.take(rows.seen)
        pose = model.without({effect.key}).pose(rows.q, rows.context())
        found = lifted_base(model.arm, pose[:, :3, 3], pose[:, :3, :3], rows)
        there = _replace_term(model, effect, _move_base(effect, *found, model))
        if _median_misfit(model, rows) > CLEARLY * _median_misfit(there, rows):
            model = there
    return model


def _replace_term(model: Model, old: Effect, new: Effect) -> Model:
    return model.with_terms([new if term is old else term for term in model.terms])


def _median_misfit(model: Model, rows: Session) -> float:
    """Return the median error of the rows, m; with orientations alone, rad from their mean."""
    if rows.placed.any():
        return median_distance(compute_tip_errors(model, rows))
    axes = model.pose(rows.q, rows.context())[:, :3, :3]
    body = Rotation.from_matrix(
        np.swapaxes(axes, 1, 2) @ compute_rotations(rows.readings["orientation"])
    )
    return float(np.median((body * body.mean().inv()).magnitude()))


def _is_unknown(model: Model, effect: Effect) -> bool:
    return any(s.parameter.unknown for s in slots_of(model.arm, [effect]))


def _move_base(effect: Effect, rotation: np.ndarray, offset: np.ndarray, model: Model) -> Effect:
    """Return a base placement moved from the declared base by a rotation (3, 3) and offset (3,)."""
    home = model.arm.base.frame().matrix()
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = rotation, offset
    motion = np.linalg.inv(home) @ moved @ home
    return effect.with_values(_twist_values(motion[:3, :3], motion[:3, 3]))


def _twist_values(rotation: np.ndarray, shift: np.ndarray) -> dict[str, float]:
    """Return the twist of a rigid motion, by component name; the inverse of `spatial.exp_large`."""
    w = Rotation.from_matrix(rotation).as_rotvec()
    angle = np.linalg.norm(w)
    hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if angle >= 1e-9:
        b = (1 - np.cos(angle)) / angle**2
        c = (angle - np.sin(angle)) / angle**3
        shift = np.linalg.solve(np.eye(3) + b * hat + c * hat @ hat, shift)
    return dict(zip(("x", "y", "z", "rx", "ry", "rz"), map(float, (*shift, *w)), strict=True))


def sensor_terms(arm: Arm, session: Session) -> tuple[Bias, ...]:
    """Return the placement terms of a session's measurements other than those of base and tip.

    These are tracked bodies, anchors, further sensors, encoders, touched points and planes.
    """
    nothing = np.full(len(session), "")
    several = len({b.sensor for b in session.blocks if b.kind == "orientation"}) > 1
    marker = session.labels.get("marker", nothing) if arm.markers else nothing
    sensor = session.labels["sensor"] if several else nothing
    seen = session.has_orientation
    bodies = {(str(m), str(s)) for m, s in zip(marker[seen], sensor[seen], strict=True)}
    made: list[Bias] = [TipOrientation(marker=m, sensor=s) for m, s in sorted(bodies)]
    for name in session.names_of(KINDS["distance"]):
        anchor = arm.anchors.get(name)
        if anchor is None or anchor.xyz_m is None:
            made.append(AnchorPlace(anchor=name))
    made += [SensorPlace(sensor=name) for name in _list_sensors(session)[1:]]
    made += [Encoder(joint=arm.commanded[k]) for k in session.read_joints]
    return (*made, *touched.touched_terms(arm, session))


def choose_reference_rows(session: Session) -> Session:
    """Return the rows in whose frame the base is placed: those of the first sensor.

    It is the sensor with the most whole positions.
    """
    names = _list_sensors(session)
    return session if len(names) < 2 else session.where("sensor", names[0])


def _list_sensors(session: Session) -> list[str]:
    """List the sensors of positions and orientations, the one with most whole positions first."""
    framed = {b.sensor for b in session.blocks if b.kind in ("position", "orientation")}
    names = sorted(name for name in framed if name is not None)
    labels = session.labels.get("sensor", np.array([]))
    return sorted(names, key=lambda name: -int((session.has_position & (labels == name)).sum()))


def place_sensors(model: Model, session: Session) -> Model:
    """Return the model with anchors, sensors, tracked bodies and touched points placed by the rows.

    Raises:
        InputError: an anchor has fewer than four distances.
    """
    puts = (
        (AnchorPlace, _place_anchor),
        (SensorPlace, _place_sensor),
        (TipOrientation, _turn_axes),
    )
    for kind, put in puts:
        made = [put(t, model, session) if isinstance(t, kind) else t for t in model.biases]  # type: ignore[arg-type]
        model = dataclasses.replace(model, biases=tuple(made))
    if not any(term.passing for term in model.biases):
        return model
    tips = model.tip(session.q, session.context())
    return dataclasses.replace(model, biases=touched.place_touched(model.biases, tips, session))


def _place_sensor(term: SensorPlace, model: Model, session: Session) -> SensorPlace:
    """Place a sensor by a rigid registration of the predicted tips to its positions."""
    rows = session.take(session.has_position & (session.labels["sensor"] == term.sensor))
    if len(rows) < 4:
        return term
    tips = model.tip(rows.q, rows.context())
    return term.with_values(_twist_values(*robust_kabsch(tips, rows.xyz)))


def _turn_axes(term: TipOrientation, model: Model, session: Session) -> TipOrientation:
    """Set a tracked body's rotation in the tip's frame to the robust mean of the rows."""
    mine = session.has_orientation.copy()
    for label, value in (("marker", term.marker), ("sensor", term.sensor)):
        if value:
            mine &= session.labels[label] == value
    rows = session.take(mine)
    bare = model.with_terms([t for t in model.terms if not isinstance(t, TipOrientation)])
    axes = bare.motion(compute_posture(bare, rows), (), turns=True).axes()[0]
    seen = compute_rotations(rows.readings["orientation"])
    between = Rotation.from_matrix(np.swapaxes(axes, 1, 2) @ seen)
    weights = np.ones(len(rows))
    for _ in range(ROUNDS):
        mean = between.mean(weights)
        weights = robust_weights((mean.inv() * between).magnitude())
    return term.with_values(dict(zip(("rx", "ry", "rz"), mean.as_rotvec(), strict=True)))


def _place_anchor(term: AnchorPlace, model: Model, session: Session) -> AnchorPlace:
    """Place an anchor by multilateration from the predicted tips."""
    measured = np.isfinite(session.readings["distance"][:, 0])
    rows = session.take(measured & (session.labels["anchor"] == term.anchor))
    if len(rows) < 4:
        allowed = "at least 4 where the anchor's place is to be solved"
        raise InputError(session.source, f"anchor {term.anchor}", f"{len(rows)} distances", allowed)
    tips = model.tip(rows.q, rows.context())
    place = multilaterate(tips, rows.readings["distance"][:, 0])
    return term.with_values(dict(zip("xyz", place, strict=True)))
