"""The paper's compensation as one pure function: target -> joints -> expected error -> joints.

One sign: ``error = measured - predicted`` and ``pseudo-target = target - expected error``
(the paper adds "the predicted error" and leaves its sign open; only this one corrects).
The physics (sag and the declared effects) sits in the inverse kinematics; the predictor
gives what the physics leaves.  The paper corrects once (`single_pass`); here the pass is
repeated until the expected error at the new joints is the one that was corrected.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.spatial import Frame
from longarm_comp.core.compensation.result import (
    NO_PREDICTOR,
    Compensation,
    Compensations,
    Method,
    Prediction,
    Predictor,
    Settling,
    Status,
    missed,
    outside,
    predictor_context,
    shifted,
)
from longarm_comp.core.compensation.single import NEARBY_STARTS, Task, compensate_one
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.model import Model

__all__ = [
    "Compensation",
    "Compensations",
    "Method",
    "Prediction",
    "Predictor",
    "Settling",
    "Status",
    "compensate",
    "compensate_many",
    "rigid",
]


def rigid(model: Model) -> Model:
    """The model without deflection: its calibrated geometry alone."""
    return _part(model, "_rigid", lambda effect: effect.geometry)


def commandable(model: Model) -> Model:
    """The model without what no command can undo: a servo's rounding (it stays in the residual)."""
    return _part(model, "_commandable", lambda effect: effect.continuous)


def _part(model: Model, name: str, wanted: Callable[[Effect], bool]) -> Model:
    """The model with some of its effects; made once, so that what was compiled for it lasts."""
    kept = tuple(e for e in model.effects if wanted(e))
    if len(kept) == len(model.effects):
        return model
    made: Model | None = model.__dict__.get(name)
    if made is None:
        made = model.__dict__[name] = dataclasses.replace(model, effects=kept)
    return made


def compensate(
    model: Model,
    predictor: Predictor | None,
    target: np.ndarray | Frame,
    *,
    context: Context | None = None,
    seed: np.ndarray | None = None,
    method: Method = Method.BOTH,
    position_only: bool = False,
    locked: Sequence[int | str] = (),
    **settling: Any,
) -> Compensation:
    """Joints that bring the *real* tip to one target; arguments as in `compensate_many`.

    Raises:
        InputError: the target is neither (3,) nor (4, 4); an option is not allowed.
    """
    given = target.matrix() if isinstance(target, Frame) else np.asarray(target, dtype=float)
    if given.shape not in ((3,), (4, 4)):
        raise InputError("compensate", "target", f"shape {given.shape}", "shape (3,) or (4, 4)")
    task = Task(
        commandable(model) if method.physics else rigid(model),
        predictor if method.learned else None,
        method.learned,
        (context or Context.empty()).take(0),
        position_only or given.ndim == 1,
        tuple(locked),
        Settling(**settling),
    )
    return compensate_one(task, given, seed)


def compensate_many(
    model: Model,
    predictor: Predictor | None,
    targets: np.ndarray,
    *,
    context: Context | None = None,
    seed: np.ndarray | None = None,
    method: Method = Method.BOTH,
    position_only: bool = False,
    locked: Sequence[int | str] = (),
    **settling: Any,
) -> Compensations:
    """Joints that bring the real tip to each of N targets.

    Args:
        model: arm and effects; methods without physics keep its geometry effects only.
        predictor: the learned residual of the model that the method uses, or None.
        targets: positions (N, 3) in m or poses (N, 4, 4), base frame.
        context: circumstances in which the arm will stand, scalars or (N,) arrays.
        seed: (n,) or (N, n) current joints; default mid-range.
        position_only: leave the orientation free.
        locked: joints that stay at their seed, as in `ik.solve_many`.
        settling: fields of `Settling`: when the passes end.

    Returns:
        One story a target; a target that is no place (NaN, no rotation) or that cannot be
        reached is an answer, not an error.

    Raises:
        InputError: wrong shapes or options.
    """
    rule = Settling(**settling)
    targets = np.asarray(targets, dtype=float)
    work = _Work(
        commandable(model) if method.physics else rigid(model),
        predictor if method.learned else None,
        targets,
        (context or Context.empty()),
        position_only or targets.ndim == 2,
        tuple(locked),
    )
    work.reach_ideal(seed)
    if method.learned and predictor is None:
        work.end(work.open, Status.NO_PREDICTOR, NO_PREDICTOR)
    elif not method.learned:
        work.end(work.open, Status.SUCCESS, "")
    work.expect(rule, first=True)
    for _ in range(1 if rule.single_pass else rule.max_passes):
        work.correct()
        if rule.single_pass:
            work.end(work.open, Status.SUCCESS, "")
        else:
            work.expect(rule)
        if not work.open.any():
            break
    work.end(work.open, Status.NOT_CONVERGED, rule.unsettled)
    return work.story()


class _Work:
    """N targets on their way; `open` marks those that are not decided."""

    def __init__(
        self,
        model: Model,
        predictor: Predictor | None,
        targets: np.ndarray,
        context: Context,
        position_only: bool,
        locked: tuple[int | str, ...],
    ) -> None:
        self.model, self.predictor, self.context = model, predictor, context
        self.position_only, self.locked = position_only, locked
        self.targets = targets
        count, n = len(targets), model.arm.n
        self.ideal, self.command = np.zeros((count, n)), np.zeros((count, n))
        self.error, self.sigma = np.zeros((count, 3)), np.full((count, 3), np.nan)
        self.in_domain = np.zeros(count, bool)
        self.passes = np.zeros(count, int)
        self.status = np.full(count, Status.SUCCESS, int)
        self.reason = [""] * count
        self.open = np.ones(count, bool)

    def end(self, which: np.ndarray, status: Status, reason: str | Sequence[str]) -> None:
        """Decide targets; no correction is left in those that fall back or fail."""
        rows = np.flatnonzero(which)
        texts = [reason] * len(rows) if isinstance(reason, str) else reason
        for row, text in zip(rows, texts, strict=True):
            self.reason[row] = text
        self.status[rows] = status
        self.open[rows] = False
        if status is not Status.SUCCESS:
            self.command[rows] = self.ideal[rows]
            if status.physics_only:
                self.error[rows] = 0.0

    def reach_ideal(self, seed: np.ndarray | None) -> None:
        """Joints by the physics alone."""
        start = ik.checked_seed(self.model, seed, len(self.targets), "compensate")
        self.ideal[:] = self.command[:] = start
        faults = ik.target_faults(self.targets, self.position_only, "compensate")
        bad = np.array([bool(f) for f in faults], bool)
        self.end(bad, Status.BAD_TARGET, [f for f in faults if f])
        self._solve(np.flatnonzero(self.open), start, self.targets, ik.MAX_STARTS)
        self.ideal[:] = self.command

    def expect(self, rule: Settling, first: bool = False) -> None:
        """The error expected at the present joints; decides what has settled."""
        rows = np.flatnonzero(self.open)
        if not rows.size or self.predictor is None:
            return
        columns = predictor_context(self.context.take(rows), len(rows))
        found = self.predictor.predict(self.command[rows], columns)
        error = np.asarray(found.error, float)
        inside = np.asarray(found.in_domain, bool) & np.isfinite(error).all(axis=1)
        change = np.linalg.norm(error - self.error[rows], axis=1)
        self.error[rows], self.sigma[rows] = error, found.sigma
        self.in_domain[rows] = inside
        size = np.linalg.norm(error, axis=1)
        large = inside & (size > rule.max_correction_m)
        texts = getattr(found, "reason", None) or [""] * len(rows)
        self._end_some(
            rows, ~inside, Status.OUT_OF_DOMAIN,
            [outside(text) for text, ok in zip(texts, inside, strict=True) if not ok],
        )  # fmt: skip
        self._end_some(
            rows, large, Status.CORRECTION_TOO_LARGE, [rule.too_large(s) for s in size[large]]
        )
        if not first:
            settled = inside & ~large & (change <= rule.tol_m)
            self._end_some(rows, settled, Status.SUCCESS, "")

    def _end_some(
        self, rows: np.ndarray, which: np.ndarray, status: Status, reason: str | Sequence[str]
    ) -> None:
        """Decide some of the given rows."""
        mask = np.zeros_like(self.open)
        mask[rows[which]] = True
        self.end(mask, status, reason)

    def correct(self) -> None:
        """One pass: joints of the pseudo-target, started from the joints before."""
        rows = np.flatnonzero(self.open)
        if rows.size:
            self.passes[rows] += 1
            self._solve(rows, self.command, shifted(self.targets, self.error), NEARBY_STARTS)

    def _solve(self, rows: np.ndarray, seed: np.ndarray, to: np.ndarray, starts: int) -> None:
        if not rows.size:
            return
        found = ik.solve_many(
            self.model,
            to[rows],
            seed=seed[rows],
            context=self.context.take(rows),
            position_only=self.position_only,
            locked=self.locked,
            max_starts=starts,
        )
        self.command[rows] = found.q
        failed = np.flatnonzero(~found.ok)
        what = "pseudo-target" if self.passes[rows].any() else "target"
        if what == "target":
            self.ideal[rows[failed]] = found.q[failed]
        texts = [missed(what, found[int(k)]) for k in failed]
        self._end_some(rows, ~found.ok, Status.UNREACHABLE, texts)

    def story(self) -> Compensations:
        """What came of it."""
        return Compensations(
            self.targets,
            self.ideal,
            self.error,
            self.sigma,
            self.in_domain,
            shifted(self.targets, self.error),
            self.command,
            self.passes,
            self.status,
            tuple(self.reason),
        )
