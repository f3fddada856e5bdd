"""The paper's compensation as one pure function: target -> joints -> expected error -> joints.

One sign: ``error = measured - predicted`` and ``pseudo-target = target - expected error``
(the paper adds "the predicted error" and leaves its sign open; only this one corrects).
The physics (sag and the declared effects) sits in the inverse kinematics; the predictor
gives what the physics leaves.  The paper corrects once (`single_pass`); here the pass is
repeated until the expected error at the new joints is the one that was corrected.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from longarm_comp.core import ik
from longarm_comp.core.compensation import (
    Compensation,
    Compensations,
    Method,
    Prediction,
    Predictor,
    Status,
)
from longarm_comp.core.context import Context
from longarm_comp.core.errors import InputError
from longarm_comp.core.model import Model
from longarm_comp.core.spatial import Frame

__all__ = [
    "Compensation",
    "Compensations",
    "Method",
    "Prediction",
    "Predictor",
    "Status",
    "compensate",
    "compensate_many",
    "rigid",
]

TOLERANCE_M = 1e-5
MAX_PASSES = 10
MAX_CORRECTION_M = 0.1
_NEARBY_STARTS = 3  # a pseudo-target lies next to its target: look near its joints only
_PREDICTOR_COLUMNS = ("temperature_c", "payload_kg", "t_s")


def rigid(model: Model) -> Model:
    """The model without deflection: its calibrated geometry alone."""
    return dataclasses.replace(model, effects=tuple(e for e in model.effects if e.geometry))


def commandable(model: Model) -> Model:
    """The model without what no command can undo: a servo's rounding (it stays in the residual)."""
    kept = tuple(e for e in model.effects if e.continuous)
    return model if len(kept) == len(model.effects) else dataclasses.replace(model, effects=kept)


def compensate(
    model: Model,
    predictor: Predictor | None,
    target: np.ndarray | Frame,
    **options: Any,
) -> Compensation:
    """Joints that bring the *real* tip to one target; options as in `compensate_many`.

    Raises:
        InputError: the target is neither (3,) nor (4, 4); an option is not allowed.
    """
    given = target.matrix() if isinstance(target, Frame) else np.asarray(target, dtype=float)
    if given.shape not in ((3,), (4, 4)):
        raise InputError("compensate", "target", f"shape {given.shape}", "shape (3,) or (4, 4)")
    return compensate_many(model, predictor, given[None], **options)[0]


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
    single_pass: bool = False,
    tol_m: float = TOLERANCE_M,
    max_passes: int = MAX_PASSES,
    max_correction_m: float = MAX_CORRECTION_M,
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
        single_pass: correct once, as in the paper.
        tol_m: the expected error may change by so much between passes at the end.
        max_passes: pseudo-target passes permitted.
        max_correction_m: length of the expected error that may be corrected.

    Returns:
        One story a target; a target that is no place (NaN, no rotation) or that cannot be
        reached is an answer, not an error.

    Raises:
        InputError: wrong shapes or options.
    """
    for field, value in (("tol_m", tol_m), ("max_correction_m", max_correction_m)):
        if not (np.isfinite(value) and value > 0):
            raise InputError("compensate", field, value, "a length above 0 m")
    if max_passes < 1:
        raise InputError("compensate", "max_passes", max_passes, "1 or more")
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
        work.end(work.open, Status.NO_PREDICTOR, "no predictor: compensated with physics only")
    elif not method.learned:
        work.end(work.open, Status.SUCCESS, "")
    work.expect(tol_m, max_correction_m, first=True)
    for _ in range(1 if single_pass else max_passes):
        work.correct()
        if single_pass:
            work.end(work.open, Status.SUCCESS, "")
        else:
            work.expect(tol_m, max_correction_m)
        if not work.open.any():
            break
    work.end(
        work.open,
        Status.NOT_CONVERGED,
        f"the expected error still changes by more than {1e3 * tol_m:g} mm "
        f"after {max_passes} passes",
    )
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
            if status in (Status.OUT_OF_DOMAIN, Status.NO_PREDICTOR):
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

    def expect(self, tol_m: float, max_correction_m: float, first: bool = False) -> None:
        """The error expected at the present joints; decides what has settled."""
        rows = np.flatnonzero(self.open)
        if not rows.size or self.predictor is None:
            return
        found = self.predictor.predict(self.command[rows], self._predictor_context(rows))
        error = np.asarray(found.error, float)
        inside = np.asarray(found.in_domain, bool) & np.isfinite(error).all(axis=1)
        change = np.linalg.norm(error - self.error[rows], axis=1)
        self.error[rows], self.sigma[rows] = error, found.sigma
        self.in_domain[rows] = inside
        large = np.linalg.norm(error, axis=1) > max_correction_m
        texts = getattr(found, "reason", None) or [""] * len(rows)
        outside = [
            "outside the predictor's training data, compensated with physics only"
            + (f": {text}" if text else "")
            for text, ok in zip(texts, inside, strict=True)
            if not ok
        ]
        mask = np.zeros_like(self.open)
        mask[rows[~inside]] = True
        self.end(mask, Status.OUT_OF_DOMAIN, outside)
        mask[:] = False
        mask[rows[inside & large]] = True
        self.end(
            mask,
            Status.CORRECTION_TOO_LARGE,
            [
                f"expected error {1e3 * np.linalg.norm(self.error[r]):.2f} mm is above the "
                f"permitted correction of {1e3 * max_correction_m:g} mm"
                for r in np.flatnonzero(mask)
            ],
        )
        if not first:
            mask[:] = False
            mask[rows[inside & ~large & (change <= tol_m)]] = True
            self.end(mask, Status.SUCCESS, "")

    def correct(self) -> None:
        """One pass: joints of the pseudo-target, started from the joints before."""
        rows = np.flatnonzero(self.open)
        if rows.size:
            self.passes[rows] += 1
            self._solve(rows, self.command, self._pseudo_targets(), _NEARBY_STARTS)

    def _solve(self, rows: np.ndarray, seed: np.ndarray, to: np.ndarray, starts: int) -> None:
        if not rows.size:
            return
        q, ok, misses = self._search(rows, seed, to, starts)
        self.command[rows] = q
        failed = rows[~ok]
        mask = np.zeros_like(self.open)
        mask[failed] = True
        what = "pseudo-target" if self.passes[rows].any() else "target"
        texts = [
            f"{what} missed by {1e3 * miss.position_residual_m:.3f} mm, "
            f"{np.degrees(miss.angle_residual_rad):.4f} deg: {miss.reason.value}"
            for miss in misses
        ]
        if what == "target":
            self.ideal[failed] = q[~ok]
        self.end(mask, Status.UNREACHABLE, texts)

    def _search(
        self, rows: np.ndarray, seed: np.ndarray, to: np.ndarray, starts: int
    ) -> tuple[np.ndarray, np.ndarray, list[ik.Solution]]:
        """Joints (M, n), whether each hits (M,), and those that miss; one target goes alone."""
        if len(rows) == 1:
            row = int(rows[0])
            one = ik.solve(
                self.model,
                to[row],
                seed=seed[row],
                context=self.context.take(row),
                position_only=self.position_only,
                locked=self.locked,
                max_starts=starts,
            )
            return one.q[None], np.array([one.ok]), [] if one.ok else [one]
        many = ik.solve_many(
            self.model,
            to[rows],
            seed=seed[rows],
            context=self.context.take(rows),
            position_only=self.position_only,
            locked=self.locked,
            max_starts=starts,
        )
        return many.q, many.ok, [many[int(k)] for k in np.flatnonzero(~many.ok)]

    def _predictor_context(self, rows: np.ndarray) -> dict[str, Any]:
        context = self.context.take(rows)
        made = {k: context.columns[k] for k in _PREDICTOR_COLUMNS if k in context.columns}
        if context.approach:
            made["approach"] = np.stack(
                [np.broadcast_to(np.asarray(a, float), rows.shape) for a in context.approach], 1
            )
        return made

    def _pseudo_targets(self) -> np.ndarray:
        pseudo = self.targets.copy()
        if pseudo.ndim == 2:
            pseudo -= self.error
        else:
            pseudo[:, :3, 3] -= self.error
        return pseudo

    def story(self) -> Compensations:
        """What came of it."""
        return Compensations(
            self.targets,
            self.ideal,
            self.error,
            self.sigma,
            self.in_domain,
            self._pseudo_targets(),
            self.command,
            self.passes,
            self.status,
            tuple(self.reason),
        )
