"""The two banks of candidates on top of a fit: of the arm's side and of the camera's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.measurement import equations, posture
from longarm_comp.core.effects.components import components, stations
from longarm_comp.core.effects.discovered import CAMERA, DISTANCE, Discovered, DiscoveredView, views
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.quantities import AXES, SeenCoordinate
from longarm_comp.core.identify.discover.bank import Bank, Spot
from longarm_comp.core.identify.discover.functions import Functions
from longarm_comp.core.identify.discover.inputs import arm_inputs, camera_inputs
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.model.model import slots_of

_STILL = 1e-12
"""Motion (m, rad) by a unit below which a component does nothing there."""


def banks(fit: ModelFit) -> tuple[Bank, ...]:
    """Candidates of the arm's side and, where positions are seen, of the camera's."""
    arm, rows = fit.model.arm, fit.session
    at = posture(fit.model, rows)
    (spots, units), *seen_sides = sides(fit)
    functions = Functions(arm_inputs(arm, at, rows))
    made = [Bank(fit, spots, units, functions, _axes(arm, spots))]
    for spots, units in seen_sides:
        points = fit.model.measured(rows.q, rows.context())
        free = all(spot.component == DISTANCE for spot in spots)
        seen = Functions(camera_inputs(points, rows), None if free else SeenCoordinate)
        made.append(Bank(fit, spots, units, seen))
    return tuple(made)


def sides(fit: ModelFit) -> Iterator[tuple[list[Spot], np.ndarray]]:
    """Components of the arm and, where positions are seen, of the camera; (N, d, K) by a unit."""
    arm = fit.model.arm
    spots = [Spot(place, name) for place in _distinct(arm) for name in components(arm)]
    units, moving = _units(fit, [term_of(p, "1", "", 1e-3) for p in spots])
    yield [p for p, moves in zip(spots, moving, strict=True) if moves], units
    if fit.session.plain:
        ways = views(arm)
        for some in (AXES, [way for way in ways if way not in AXES]):
            seen = [Spot(CAMERA, way) for way in some]
            if seen:
                yield seen, _units(fit, [term_of(p, "1", "", 1e-3) for p in seen])[0]


def term_of(
    place: Spot, function: str, domain: str, scale: float, amount: float = 0.0
) -> Effect | Bias:
    """The term of a model that a place and a function stand for."""
    if place.at == CAMERA:
        return DiscoveredView(place.component, function, domain, scale, amount)
    return Discovered(place.at, place.component, function, domain, scale, amount)


def _distinct(arm: Arm) -> list[str]:
    """Places that are not the same as another: a row's end where it has a length."""
    same = {f"frame {j.id}" for j in arm.joints if j.d_m == 0 and j.type != "prismatic"}
    if arm.tip.frame and not any(arm.tip.position_m):
        same.add(f"frame {arm.tip.frame}")
    return [name for name in stations(arm) if name not in same]


def _units(fit: ModelFit, terms: list[Effect | Bias]) -> tuple[np.ndarray, np.ndarray]:
    """(N, d, K) motion by a unit of each term that moves anything, and which do, (K,)."""
    at = posture(fit.model, fit.session)
    slots = slots_of(fit.model.arm, terms)
    columns = equations(fit.model, fit.session, at, slots).columns
    moving = np.abs(columns).max(axis=(0, 1)) > _STILL
    return columns[..., moving], moving


def _axes(arm: Arm, places: list[Spot]) -> list[Spot]:
    """By commanded joint, the place that moves it along its own axis."""
    made = []
    for row in arm.commanded:
        word = "move" if arm.joints[row - 1].type == "prismatic" else "turn"
        place = Spot(f"joint {row}", f"{word} z")
        if place in places:
            made.append(place)
    return made if len(made) == arm.n else []
