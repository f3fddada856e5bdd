"""Computes joints and times that bring the real tip along a path."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import SAME_POSE, History
from longarm_comp.core.arm.moves import Move
from longarm_comp.core.compensation.arrive import Arrival
from longarm_comp.core.compensation.path import compensate_path as solve_path
from longarm_comp.core.compensation.planned_path import (
    CubicPath,
    MotionLimits,
    PathLimits,
    PlannedPath,
)
from longarm_comp.core.compensation.result import CompensationOptions, Method
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import joint_names
from longarm_comp.sessions.targets import Targets
from longarm_comp.workflows import compensate as points
from longarm_comp.workflows.inputs import SessionLike, check_predictor


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class PathCommands(points.Commands):
    """The results at the way-points of a path, in their order, and when each is due.

    Attributes:
        timed: times (s), joints (rad, m) and velocities (rad/s, m/s) at the way-points.
        correction_m: (N,) by how much the declared arm's tip is moved, m: `measure_correction`.
        notes: warnings about way-points, without repetition.
    """

    timed: CubicPath
    correction_m: np.ndarray
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        return f"PathCommands({len(self)} way-points, {self.timed.times[-1]:.3g} s)"

    def lines(self) -> list[dict[str, Any]]:
        """Return the lines of `Commands`, with t_s and velocities v_q1..v_qn added."""
        further = np.column_stack([self.timed.times, self.timed.velocities])
        names = ("t_s", *(f"v_{name}" for name in joint_names(further.shape[1] - 1)))
        rows = zip(super().lines(), further.tolist(), strict=True)
        return [line | dict(zip(names, row, strict=True)) for line, row in rows]


def compensate_path(
    model: Model,
    path: ArrayLike | Targets,
    predictor: Predictor | None = None,
    *,
    times: ArrayLike | None = None,
    method: Method | str | None = None,
    frame: str | None = None,
    context: Context | None = None,
    history: SessionLike | None = None,
    max_velocity: ArrayLike | None = None,
    max_acceleration: ArrayLike | None = None,
    max_turn_rad: float = PathLimits.max_turn_rad,
    max_longer: float = PathLimits.max_longer,
    seed: ArrayLike | None = None,
    position_only: bool = False,
    locked: Sequence[int | str] = (),
    **settling: Any,
) -> PathCommands:
    """Compute joints that bring the real tip of an arm along a path, with their times.

    Args:
        model, predictor, method, frame, context, history, locked, settling: as in `compensate`.
        path: way-points in their order: positions (N, 3) in m or poses (N, 4, 4), or `Targets`
            that were read from a file; their t_s are the times.
        times: (N,) s, rising. They are kept if the limits allow and no play is taken up. None: as
            fast as both limits allow; without limits, one second for each way-point.
        max_velocity, max_acceleration: one for every joint, or (n,); rad/s and m/s, or rad/s^2 and
            m/s^2.
        max_turn_rad: largest error of the orientation where the joints cannot hold it.
        max_longer: largest fraction of time that may be added to take up play smoothly where joints
            reverse; 0: the times are kept.
        seed: (n,) joints to start the first search from.
        position_only: leave the orientation free.

    Raises:
        PathRefused: a way-point cannot be reached, or a limit or a keep-out box is in the way.
        InputError: as `compensate`; shapes or times are not allowed.
    """
    if predictor is not None:
        check_predictor(predictor, model, "compensate")
    chosen = points.method_of(method, predictor)
    numbers, placements, goals, told = points.place_targets(model, path, context, frame or "")
    if len({goal.ndim for goal in goals}) > 1:
        raise InputError("path", "qx", "at some way-points", "at every way-point or at none")
    if times is None and isinstance(path, Targets):
        times = path.columns.get("t_s")
    n = model.arm.n
    carried = np.array(goals)
    motion = MotionLimits(
        _per_joint(max_velocity, n, "max_velocity"),
        _per_joint(max_acceleration, n, "max_acceleration"),
    )
    limits = PathLimits(motion, max_turn_rad, max_longer=max_longer, position_only=position_only)
    start, came = (
        (None, History.unknown(n)) if history is None else points.find_last_rest(history, model)
    )
    first = start if seed is None else np.asarray(seed, float)
    model = placements[0].promising(model)
    found = solve_path(
        model,
        predictor,
        PlannedPath(carried, None if times is None else np.asarray(times, float)),
        start=start,
        history=came,
        seed=first,
        context_at=lambda arrived: points.complete_after_move(told, arrived),
        limits=limits,
        options=CompensationOptions(chosen, locked, **settling),
    )
    joints = found.timed.joints
    steps = np.diff(joints, axis=0, prepend=(joints[0] if start is None else start)[None])
    sides = np.where(np.abs(steps) < SAME_POSE, 0.0, np.sign(steps))
    outcomes = found.each(model, chosen, carried)
    contexts = found.context.each(len(carried))
    arrivals = tuple(
        Arrival(outcome, Move(q, None, side, np.zeros(n, bool)), context, found.history)
        for outcome, q, side, context in zip(outcomes, joints, sides, contexts, strict=True)
    )
    return PathCommands(
        numbers,
        arrivals,
        placements,
        timed=found.timed,
        correction_m=found.correction_m,
        notes=found.notes,
    )


def _per_joint(given: ArrayLike | None, n: int, name: str) -> np.ndarray:
    values = np.asarray(np.inf if given is None else given, float)
    if values.shape not in ((), (1,), (n,)) or not (values > 0.0).all():
        raise InputError("path", name, np.atleast_1d(values).tolist(), f"one or {n}, above 0")
    return np.array(np.broadcast_to(values, n), float)
