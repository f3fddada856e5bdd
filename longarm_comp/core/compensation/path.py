"""A planned path: joints that bring the real tip where the plan meant it, one way-point on.

Way-points are solved in their order, each from the planned joints (without them from the joints
before), and for the history that the path up to it leaves in the joints. No run-ups, no choice
among servo steps and no restarts of the search, so joints do not jump where the plan does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.arrive import Arrival, CompensationOptions, compensate_move
from longarm_comp.core.compensation.result import Method, ResidualPredictor, Status
from longarm_comp.core.compensation.retime import (
    MotionLimits,
    Timed,
    fastest,
    retimed,
    slopes_of,
)
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.keep_out import entered_at
from longarm_comp.core.model.model import Model

_POSE_JOINTS = 6
"""An arm of fewer joints cannot keep a planned orientation: its path is one of positions."""


class PathRefused(JobError):  # noqa: N818
    """A path that cannot be followed; nothing of it was sent."""

    def __init__(self, status: Status, row: int, why: str) -> None:
        super().__init__(f"way-point {row}: {status}: {why}")
        self.status, self.row = status, row


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Way-points of the tip, base frame, and how a planner would have the joints bring it there.

    Attributes:
        targets: (k, 3) m or (k, 4, 4).
        times: (k,) s, increasing; None: as fast as the limits allow.
        joints: (k, n) as planned, to start each search from; None: none were planned.
        velocities: (k, n) as planned; None: none were.
        begun: the first way-point is where the planner believes the arm to stand.
    """

    targets: np.ndarray
    times: np.ndarray | None = None
    joints: np.ndarray | None = None
    velocities: np.ndarray | None = None
    begun: bool = False

    @classmethod
    def of_joints(
        cls, arm: Arm, times: np.ndarray, joints: np.ndarray, velocities: np.ndarray | None = None
    ) -> PlannedPath:
        """What a planner means with joints (k, n): the tip of the declared arm, rigid.

        The first way-point is where it believes the arm to stand.
        """
        poses = Model(arm).pose(joints)
        targets = poses if arm.n >= _POSE_JOINTS else poses[:, :3, 3]
        return cls(targets, times, joints, velocities, begun=True)


@dataclass(frozen=True, eq=False)
class CompensatedPath:
    """A path to send.

    Attributes:
        timed: joints, velocities and times; where the plan has neither times nor limits, a second
            a way-point.
        arrivals: of each way-point that was solved; not of one where the arm stood already.
        correction_m: (k,) m, by how much the declared arm's tip is moved.
        history: of the joints at the end.
        notes: doubts of way-points, each once.
    """

    timed: Timed
    arrivals: tuple[Arrival, ...]
    correction_m: np.ndarray
    history: History
    notes: tuple[str, ...]


def compensate_path(
    model: Model,
    predictor: ResidualPredictor | None,
    plan: PlannedPath,
    *,
    start: np.ndarray | None,
    history: History,
    context_after: Callable[[History, int], Context],
    seed: np.ndarray | None = None,
    limits: MotionLimits | None = None,
    max_correction_m: float = np.inf,
    position_only: bool = False,
    options: CompensationOptions | None = None,
) -> CompensatedPath:
    """Joints and times for a plan, or the reason why there are none.

    Where the predictor cannot answer for every way-point, none is corrected by it: between
    corrected and uncorrected ones the tip would jump.

    Args:
        start: (n,) where the joints stand; None: not known. A plan that has begun begins there.
        history: of the joints at ``start``.
        context_after: the circumstances at a way-point, given the history there and its number.
        seed: (n,) start of the first search, where no joints were planned; ``start`` by default.
        max_correction_m: most that the declared arm's tip may be moved, m.

    Raises:
        PathRefused: a way-point cannot be reached, or needs too large a correction; a limit or a
            box is in the way.
        InputError: the plan's shapes or times are not allowed.
    """
    arm = model.arm
    _check(plan, arm.n)
    options = options or CompensationOptions()
    if predictor is None:
        options = replace(options, method=_WITHOUT[options.method])
    chosen = replace(options, run_up=False, realisable=False)
    begun = plan.begun and start is not None
    at, came = start, history
    arrivals: list[Arrival] = []
    for row in range(int(begun), len(plan.targets)):
        guess = at if arrivals or seed is None else seed
        if plan.joints is not None:
            guess = np.clip(plan.joints[row], arm.lower, arm.upper)
        alone = plan.joints is None and not arrivals
        arrival = compensate_move(
            model, predictor, plan.targets[row], start=at, history=came, seed=guess,
            context_after=partial(_at_row, context_after, row),
            position_only=position_only or plan.targets.ndim == 2,
            options=chosen if alone else replace(chosen, starts=1),
        )  # fmt: skip
        outcome = arrival.outcome
        if not outcome.success:
            raise PathRefused(outcome.status, row, outcome.reason)
        if outcome.status.physics_only and predictor is not None:
            found = compensate_path(
                model, None, plan, start=start, history=history, context_after=context_after,
                seed=seed, limits=limits, max_correction_m=max_correction_m,
                position_only=position_only, options=options,
            )  # fmt: skip
            why = f"physics only, as way-point {row} is {outcome.status}: {outcome.reason}"
            return replace(found, notes=(why, *found.notes))
        at, came = outcome.command, arrival.history
        arrivals.append(arrival)
    joints = np.array([a.outcome.command for a in arrivals])
    if begun and start is not None:
        joints = np.vstack([start, joints.reshape(-1, arm.n)])
    corrected = _corrections(model.arm, plan, joints, int(begun), max_correction_m)
    timed = _timed(plan, joints, limits or MotionLimits.none(arm.n), arm)
    _keep_out(arm, timed)
    notes = dict.fromkeys(a.outcome.reason for a in arrivals if a.outcome.reason)
    return CompensatedPath(timed, tuple(arrivals), corrected, came, tuple(notes))


def _at_row(
    context_after: Callable[[History, int], Context], row: int, arrived: History
) -> Context:
    return context_after(arrived, row)


def as_planned(rigid: Model, model: Model, q: np.ndarray, context: Context) -> np.ndarray:
    """(n,) joints at which the declared, ``rigid`` arm has its tip where the model's is at q (n,).

    Where none inside the limits do, the nearest.
    """
    real = model.pose(q, context)
    target = real if model.arm.n >= _POSE_JOINTS else real[:3, 3]
    return ik.solve(rigid, target, seed=q, max_starts=1).q


_WITHOUT = {
    Method.BOTH: Method.DEFLECTION, Method.NETWORK: Method.NONE,
    Method.DEFLECTION: Method.DEFLECTION, Method.NONE: Method.NONE,
}  # fmt: skip
"""Methods without what is learned."""


def _check(plan: PlannedPath, n: int) -> None:
    k = len(plan.targets)
    if not k or plan.targets.shape[1:] not in ((3,), (4, 4)):
        allowed = "(k, 3) or (k, 4, 4), k of at least 1"
        raise InputError("path", "targets", f"shape {plan.targets.shape}", allowed)
    for name in ("joints", "velocities"):
        given = getattr(plan, name)
        if given is not None and (given.shape != (k, n) or not np.isfinite(given).all()):
            raise InputError("path", name, f"shape {given.shape}", f"({k}, {n}), finite")
    if plan.times is None:
        return
    if plan.times.shape != (k,) or not np.isfinite(plan.times).all():
        raise InputError("path", "times", f"shape {plan.times.shape}", f"({k},), finite")
    for row, (before, now) in enumerate(zip(np.r_[-np.inf, plan.times], plan.times, strict=False)):
        if now <= before or now < 0.0:
            raise InputError("path", f"time of way-point {row}", float(now), "0 s or later, rising")


def _corrections(
    arm: Arm, plan: PlannedPath, joints: np.ndarray, first: int, most_m: float
) -> np.ndarray:
    """(k,) m: how far the declared arm's tip is moved; refused where that is too far."""
    wanted = plan.targets if plan.targets.ndim == 2 else plan.targets[:, :3, 3]
    moved = np.linalg.norm(Model(arm).tip(joints) - wanted, axis=1)
    row = first + int(np.argmax(moved[first:])) if first < len(moved) else 0
    if first < len(moved) and moved[row] > most_m:
        raise PathRefused(
            Status.CORRECTION_TOO_LARGE, row,
            f"{1e3 * moved[row]:.2f} mm, allowed {1e3 * most_m:g} mm",
        )  # fmt: skip
    return moved


def _timed(plan: PlannedPath, joints: np.ndarray, limits: MotionLimits, arm: Arm) -> Timed:
    """Way-points (k, n) at the plan's times, or later where limits demand it."""
    count = len(joints)
    first = 0.0 if plan.times is None else float(plan.times[0])
    if count == 1:
        return Timed(np.array([first]), joints, np.zeros_like(joints))
    times = np.arange(float(count)) if plan.times is None else plan.times - first
    slopes = slopes_of(times, joints)
    if plan.velocities is not None and plan.joints is not None:
        slopes = plan.velocities + slopes_of(times, joints - plan.joints)
        slopes[[0, -1]] = 0.0
    try:
        if plan.times is None and limits.bounded:
            return fastest(joints, limits)
        timed = retimed(Timed(times, joints, slopes), limits)
    except JobError as error:
        raise PathRefused(Status.NOT_CONVERGED, 0, str(error)) from None
    return replace(timed, times=timed.times + first)


def _keep_out(arm: Arm, timed: Timed) -> None:
    """Refuse a path that enters a box."""
    if not arm.keep_out:
        return
    model, places = declared_model(arm), np.split(timed.between, max(1, len(timed.times) - 1))
    for row, times in enumerate(places, 1):
        if entry := entered_at(model, timed.at(times)):
            raise PathRefused(Status.KEPT_OUT, row, entry)
