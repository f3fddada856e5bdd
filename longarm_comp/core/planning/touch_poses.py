"""Poses at which an arm's tip touches points, from which a plan of touches chooses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.parts import Vec3
from longarm_comp.core.data.plan import Plan, random_joints
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.solver import solve_many
from longarm_comp.core.model.model import Model


def draw_touch_poses(
    model: Model, points: Mapping[str, Vec3], count: int, rng: np.random.Generator
) -> Plan:
    """Return poses at which the model's tip is at one of some points, from random starts.

    Args:
        points: approximate position of each point, m, base frame, by name.
        count: number of starts for all points together; each point has at least two.

    Raises:
        InputError: no point, or one for which fewer than two poses were found.
    """
    if not points:
        raise InputError("plan", "points", "none", "names and places (m) of points to touch")
    model = model.told_by(Context())
    parts, names = [], []
    each = max(count // len(points), 2)
    for name, place in points.items():
        start = random_joints(model.arm, each, rng)
        to = np.tile(place, (each, 1))
        found = solve_many(model, to, seed=start, position_only=True, max_starts=1)
        there = found.q[found.ok]
        if len(there) < 2:
            said = ", ".join(f"{v:g}" for v in place)
            raise InputError("plan", f"point {name}", said, "a place (m) that the arm reaches")
        parts.append(there)
        names += [name] * len(there)
    q = np.concatenate(parts)
    return Plan(q, np.where(rng.random(q.shape) < 0.5, 1.0, -1.0), None, np.array(names))
