"""The placement: solves from the sightings where bases, markers, sensors, anchors and points are.

A placement is never a finding.  Its start is computed here in closed form, and it is fitted jointly
with all else by `fit_model`, with priors that do not pull (`Parameter.unknown`).
"""

from __future__ import annotations

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
"""A placement that the model holds is kept unless the solved one fits so many times better."""
ENOUGH = 4
"""Rows with a full position, at least, to register bases and markers to them."""
BEYOND, ROUGHLY = 10.0, 0.2
"""Standard deviations that a known base may be off, and m or rad for what registration misses."""


def place_bases(model: Model, session: Session) -> Model:
    """Put the model's unknown bases and markers where the sightings say.

    Where hardly any row holds a full position, the bases are placed by what else was measured, and
    the markers are left as they are.

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
    """Put unknown bases where coordinates, distances, rays and axes say, if that fits better."""
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
    """Return the median error of the rows (m).

    Where only orientations are measured, it is the median angle (rad) by which the marker's turn on
    the tip differs from its mean.
    """
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
    """Return the base that has been moved from the declared one by a rotation and an offset."""
    home = model.arm.base.frame().matrix()
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = rotation, offset
    motion = np.linalg.inv(home) @ moved @ home
    return effect.with_values(_twist_values(motion[:3, :3], motion[:3, 3]))


def _twist_values(rotation: np.ndarray, shift: np.ndarray) -> dict[str, float]:
    """Return the twist of a finite motion by its parts' names: `spatial.exp_large` inverted."""
    w = Rotation.from_matrix(rotation).as_rotvec()
    angle = np.linalg.norm(w)
    hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if angle >= 1e-9:
        b = (1 - np.cos(angle)) / angle**2
        c = (angle - np.sin(angle)) / angle**3
        shift = np.linalg.solve(np.eye(3) + b * hat + c * hat @ hat, shift)
    return dict(zip(("x", "y", "z", "rx", "ry", "rz"), map(float, (*shift, *w)), strict=True))


def sensor_terms(arm: Arm, session: Session) -> tuple[Bias, ...]:
    """Return the placement terms that a session's measurements need besides base and tip."""
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
    """Return the rows in whose frame the base is placed: those of the first sensor of positions."""
    names = _list_sensors(session)
    return session if len(names) < 2 else session.where("sensor", names[0])


def _list_sensors(session: Session) -> list[str]:
    """List the sensors of positions and poses, the one with most complete positions first."""
    framed = {b.sensor for b in session.blocks if b.kind in ("position", "orientation")}
    names = sorted(name for name in framed if name is not None)
    labels = session.labels.get("sensor", np.array([]))
    return sorted(names, key=lambda name: -int((session.has_position & (labels == name)).sum()))


def place_sensors(model: Model, session: Session) -> Model:
    """Put the model's sensor frames where the rows say; others are left as they are.

    Raises:
        InputError: fewer rows than an anchor's place has unknowns.
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
    """Place a sensor by a rigid registration of the predicted tips to what it sees."""
    rows = session.take(session.has_position & (session.labels["sensor"] == term.sensor))
    if len(rows) < 4:
        return term
    tips = model.tip(rows.q, rows.context())
    return term.with_values(_twist_values(*robust_kabsch(tips, rows.xyz)))


def _turn_axes(term: TipOrientation, model: Model, session: Session) -> TipOrientation:
    """Find the mean rotation from the predicted to the measured axes, in the tip's frame."""
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
    """Find an anchor's place by multilateration from the predicted tips."""
    measured = np.isfinite(session.readings["distance"][:, 0])
    rows = session.take(measured & (session.labels["anchor"] == term.anchor))
    if len(rows) < 4:
        allowed = "at least 4 where the anchor's place is to be solved"
        raise InputError(session.source, f"anchor {term.anchor}", f"{len(rows)} distances", allowed)
    tips = model.tip(rows.q, rows.context())
    place = multilaterate(tips, rows.readings["distance"][:, 0])
    return term.with_values(dict(zip("xyz", place, strict=True)))
