"""Placement: where bases and markers are, solved from the sightings and not from what is declared.

A placement is never a finding.  It is started in closed form here, and fitted jointly with all
else by `fit`, with priors that do not pull (`Parameter.unknown`).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.data.kinds import matrices
from longarm_comp.core.data.lifted_base import lifted_base
from longarm_comp.core.data.measurement import errors
from longarm_comp.core.data.registration import Registration, Sightings, register
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.base_pose import BasePose
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.tip_offset import TipOffset
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model, slots_of

CLEARLY = 2.0
"""A placement that the model holds is kept unless the solved one fits so many times better."""
ENOUGH = 4
"""Rows with a full position, at least, to register bases and markers to them."""
BEYOND, ROUGHLY = 10.0, 0.2
"""Standard deviations that a known base may be off, and m or rad for what registration misses."""


def placed(model: Model, session: Session) -> Model:
    """The model with its unknown bases and markers put where the sightings say.

    Args:
        model: holds a `base_pose` per group and the markers' `tip_offset`.
        session: measured rows. Where hardly any holds a full position, the bases are placed by
            what else was measured, and the markers are left as they are.

    Raises:
        InputError: a base is far beyond its declared tolerance.
    """
    seen = session.take(session.located)
    frames = [e for e in model.effects if isinstance(e, BasePose | TipOffset)]
    tips = any(isinstance(e, TipOffset) and _unknown(model, e) for e in frames)
    held = [e for e in frames if isinstance(e, BasePose) or tips]
    if not held:
        return model
    if len(seen) < ENOUGH:
        return _lifted(model, session)
    kept = tuple(e for e in model.effects if not any(e is h for h in held))
    markers = sorted({e.marker for e in held if isinstance(e, TipOffset)}) or [""]
    groups = sorted({e.group for e in held if isinstance(e, BasePose)}) or [""]
    rows = Sightings.of(dataclasses.replace(model, effects=kept), seen, groups, markers)
    found = register(rows, tips)
    now = np.linalg.norm(seen.xyz - model.measured(seen.q, seen.context()), axis=1)
    alike = [rows.group + len(groups) * rows.marker == k for k in range(len(groups) * len(markers))]
    if all(np.median(now[mine]) <= CLEARLY * found.misfit for mine in alike if mine.any()):
        return model
    effects = list(model.effects)
    for k, effect in enumerate(effects):
        if not any(effect is h for h in held):
            continue
        solved = _put(effect, found, (groups, markers), model)
        if _unknown(model, effect):
            effects[k] = solved
        elif isinstance(effect, BasePose):
            _check_tolerance(model, effect, solved, session.source)
    return dataclasses.replace(model, effects=tuple(effects))


def _lifted(model: Model, session: Session) -> Model:
    """Unknown bases put where coordinates, distances, rays and axes say, where that fits better."""
    effects = list(model.effects)
    for k, effect in enumerate(effects):
        if not (isinstance(effect, BasePose) and _unknown(model, effect)):
            continue
        rows = session.where("group", effect.group) if effect.group else session
        rows = rows.take(rows.seen)
        bare = dataclasses.replace(model, effects=tuple(e for e in effects if e is not effect))
        pose = bare.pose(rows.q, rows.context())
        found = lifted_base(model.arm, pose[:, :3, 3], pose[:, :3, :3], rows)
        put = effects.copy()
        put[k] = _at(effect, *found, model)
        there = dataclasses.replace(model, effects=tuple(put))
        if _misfit(dataclasses.replace(model, effects=tuple(effects)), rows) > CLEARLY * _misfit(
            there, rows
        ):
            effects = put
    return dataclasses.replace(model, effects=tuple(effects))


def _misfit(model: Model, rows: Session) -> float:
    """Median error of the rows (m); of axes alone, how the body turns on the tip (rad)."""
    if rows.placed.any():
        return float(np.median(np.linalg.norm(errors(model, rows), axis=1)))
    axes = model.pose(rows.q, rows.context())[:, :3, :3]
    body = Rotation.from_matrix(np.swapaxes(axes, 1, 2) @ matrices(rows.readings["orientation"]))
    return float(np.median((body * body.mean().inv()).magnitude()))


def _check_tolerance(model: Model, declared: Effect, solved: Effect, source: str) -> None:
    """A base that is far from where a tolerance puts it is not fitted from there."""
    for p in declared.parameters(model.arm):
        away = abs(getattr(solved, p.name) - getattr(declared, p.name))
        if away > BEYOND * p.width + ROUGHLY:
            allowed = f"within tolerance.base of arm.yaml, {p.name} {p.width:.3g} {p.unit}; leave "
            allowed += "no tolerance, if the base may stand anywhere"
            raise InputError(source, declared.where, f"{p.name} {away:.3g} {p.unit} off", allowed)


def _unknown(model: Model, effect: Effect) -> bool:
    return any(s.parameter.unknown for s in slots_of(model.arm, [effect]))


def _put(
    effect: Effect, found: Registration, names: tuple[list[str], list[str]], model: Model
) -> Effect:
    groups, markers = names
    if isinstance(effect, TipOffset):
        return effect.with_values(
            dict(zip("xyz", found.tip[markers.index(effect.marker)], strict=True))
        )
    assert isinstance(effect, BasePose)
    g = groups.index(effect.group)
    return _at(effect, found.rotation[g], found.offset[g], model)


def _at(effect: Effect, rotation: np.ndarray, offset: np.ndarray, model: Model) -> Effect:
    """The base that takes what stands at the declared one there."""
    home = model.arm.base.frame().matrix()
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = rotation, offset
    d, w = twist_of(np.linalg.inv(home) @ moved @ home)
    return effect.with_values(dict(zip(("x", "y", "z", "rx", "ry", "rz"), (*d, *w), strict=True)))


def twist_of(motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twist of a finite motion (4, 4): the inverse of `spatial.exp_large`."""
    w, shift = Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]
    angle = np.linalg.norm(w)
    hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if angle < 1e-9:
        return shift, w
    b = (1 - np.cos(angle)) / angle**2
    c = (angle - np.sin(angle)) / angle**3
    return np.linalg.solve(np.eye(3) + b * hat + c * hat @ hat, shift), w
