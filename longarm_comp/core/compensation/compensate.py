"""The paper's compensation as one pure function: target -> joints -> expected error -> joints.

One sign: ``error = measured - predicted`` and ``pseudo-target = target - expected error``
(the paper adds "the predicted error" and leaves its sign open; only this one corrects).
The physics (sag and the declared effects) sits in the inverse kinematics; the predictor
gives what the physics leaves.  The paper corrects once (`single_pass`); here the pass is
repeated until the expected error at the new joints is the one that was corrected.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.spatial import Frame
from longarm_comp.core.compensation.expected import ExpectedMiss, expected_miss
from longarm_comp.core.compensation.realisable import Lattice, Realisable, Search, choose
from longarm_comp.core.compensation.result import (
    NO_PREDICTOR,
    Compensation,
    CompensationOptions,
    Method,
    ResidualPredictor,
    Status,
    missed,
    other_unit,
    outside,
    shifted,
)
from longarm_comp.core.compensation.unknown import (
    missing_column,
    outside_data,
    uncertain_payload,
    unknown_history,
)
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.forward import tip_poses
from longarm_comp.core.ik.kernel import characteristic_length
from longarm_comp.core.model.link_frames import reach
from longarm_comp.core.model.model import Model

_ContextAt = Callable[[np.ndarray], Context]


def rigid(model: Model) -> Model:
    """The model without deflection: its calibrated geometry alone."""
    return _part(model, "_rigid", lambda effect: effect.geometry)


def commandable(model: Model) -> Model:
    """The model without what no command can undo: a servo's rounding (it stays in the residual)."""
    return _part(model, "_commandable", lambda effect: effect.continuous)


def physics_of(model: Model, method: Method) -> Model:
    """The part of a model that a method's inverse kinematics knows."""
    return commandable(model) if method.physics else rigid(model)


def _part(model: Model, name: str, wanted: Callable[[Effect], bool]) -> Model:
    """The model with some of its effects; built once, so that what was compiled for it lasts."""
    kept = tuple(e for e in model.effects if wanted(e))
    if len(kept) == len(model.effects):
        return model
    part: Model | None = model.__dict__.get(name)
    if part is None:
        part = model.__dict__[name] = dataclasses.replace(model, effects=kept)
    return part


def compensate(
    model: Model,
    predictor: ResidualPredictor | None,
    target: np.ndarray | Frame,
    *,
    context: Context | None = None,
    seed: np.ndarray | None = None,
    position_only: bool = False,
    doubtful: np.ndarray | None = None,
    context_at: _ContextAt | None = None,
    **options: Any,
) -> Compensation:
    """Joints that bring the *real* tip to one target.

    Args:
        predictor: the learned residual of the model that the method uses.
        target: position (3,) in m, or pose (4, 4) or `Frame`, base frame.
        context: circumstances in which the arm will stand.
        seed: (n,) current joints; default mid-range.
        doubtful: (n,) joints whose side of arrival the context tells, but not for certain.
        context_at: circumstances at joints (M, n), where the way there depends on the joints; the
            choice among the steps judges each command in its own. Default: ``context`` for all.
        options: of `CompensationOptions`.

    Returns:
        Invalid or unreachable targets are reported in `status`, not raised.  So is a recorded
        quantity that an effect of the model needs and the context lacks.  `expected_m` says how
        good the command is.  Where the history of the joints is not known and the tip depends on
        it, `reason` says how much that is of it.
    """
    given = target.matrix() if isinstance(target, Frame) else np.asarray(target, dtype=float)
    if given.shape not in ((3,), (4, 4)):
        raise InputError("compensate", "target", f"shape {given.shape}", "shape (3,) or (4, 4)")
    return _Target(
        model, predictor, given, (context or Context.empty()).take(0),
        ik.checked_seed(model, seed, 1, "compensate")[0], position_only or given.ndim == 1,
        doubtful, context_at, CompensationOptions(**options),
    ).reach()  # fmt: skip


def judged(
    model: Model,
    method: Method,
    command: np.ndarray,
    context: Context,
    pseudo: np.ndarray,
    sigma: np.ndarray | None,
    doubtful: np.ndarray | None = None,
) -> tuple[ExpectedMiss, np.ndarray, list[str]]:
    """How far off a command may be, or each of M, by all that the model knows; what it cannot know.

    Args:
        command: (n,) or (M, n) joints. pseudo: (..., 3) m, where the physics should bring the tip.
        sigma: (..., 3) m of the learned error that was taken off; None: none was.
        doubtful: as in `compensate`.

    Returns:
        Second, whether the model's own error is one that its fitted rows have too, (...); third,
        the doubts of each command, in words.
    """
    physics = physics_of(model, method)
    whole = sigma is None and not missing_column(model, context)
    miss = expected_miss(model if whole else physics, command, context, pseudo, sigma)
    rows = np.atleast_2d(command)
    spread, why = unknown_history(physics, rows, context, doubtful)
    sag, doubt = uncertain_payload(physics, rows, context)
    further = (spread**2 + sag**2).reshape(miss.mean.shape)
    said = zip(why, doubt, outside_data(physics, rows, context), strict=True)
    doubts = ["; ".join(filter(None, each)) for each in said]
    known = -np.inf if model.uncertainty is None else model.uncertainty.largest_m
    return miss.beside(further), miss.sizes[0] <= known, doubts


def lattice_of(model: Model, realisable: bool | Lattice) -> Lattice | None:
    """Where the servos can stand; None: nothing is known of it, or it is not asked for."""
    if realisable is False or (realisable is True and not model.arm.steps.any()):
        return None
    lattice = Lattice.of(model.arm) if realisable is True else realisable
    return lattice if lattice.step.any() else None


@dataclass
class _Target:
    """One target on its way: ideal joints, then passes of the pseudo-target."""

    whole: Model
    predictor: ResidualPredictor | None
    target: np.ndarray
    context: Context
    seed: np.ndarray
    position_only: bool
    doubtful: np.ndarray | None
    context_at: _ContextAt | None
    options: CompensationOptions

    def __post_init__(self) -> None:
        self.method = self.options.method
        self.model = physics_of(self.whole, self.method)
        self.ideal = self.q = self.seed
        self.error, self.sigma = np.zeros(3), np.full(3, np.nan)
        self.inside, self.passes = False, 0

    def reach(self) -> Compensation:
        """Solve for the target, then correct for the expected error until it settles."""
        fault = ik.target_faults(self.target[None], self.position_only, "compensate")[0]
        if fault:
            return self._ended(Status.BAD_TARGET, fault)
        lacking = missing_column(self.model, self.context)
        if lacking:
            return self._ended(Status.STALE_CONTEXT, lacking)
        found = self._search(self.target, self.options.starts)
        self.ideal = self.q = found.q
        if not found.ok:
            why = other_unit(ik.position_of(self.target), *reach(self.model))
            return self._ended(Status.UNREACHABLE, why or missed("target", found))
        if not self.method.learned:
            return self._ended(Status.SUCCESS)
        if self.predictor is None:
            return self._ended(Status.NO_PREDICTOR, NO_PREDICTOR)
        return self._correct(self.predictor)

    def _correct(self, predictor: ResidualPredictor) -> Compensation:
        options = self.options
        while True:
            expected = predictor.predict(self.q[None], self.context)
            before, self.error = self.error, np.asarray(expected.error[0], float)
            self.sigma = np.asarray(expected.sigma[0], float)
            size = math.sqrt(self.error @ self.error)
            self.inside = bool(expected.in_domain[0]) and math.isfinite(size)
            if not self.inside:
                return self._ended(Status.OUT_OF_DOMAIN, outside(*expected.reason[:1]))
            if size > options.max_correction_m:
                return self._ended(Status.CORRECTION_TOO_LARGE, options.too_large(size))
            if self.passes and math.dist(self.error, before) <= options.tol_m:
                return self._ended(Status.SUCCESS)
            if self.passes == options.max_passes:
                return self._ended(Status.NOT_CONVERGED, options.unsettled)
            self.passes += 1
            # A pseudo-target lies next to its target: look near its joints only
            found = self._search(shifted(self.target, self.error), min(self.options.starts, 3))
            if not found.ok:
                return self._ended(Status.UNREACHABLE, missed("pseudo-target", found))
            self.q = found.q
            if options.single_pass:
                return self._ended(Status.SUCCESS)

    def _search(self, to: np.ndarray, starts: int) -> ik.Solution:
        return ik.solve(
            self.model, to, seed=self.q, context=self.context, position_only=self.position_only,
            locked=self.options.locked, max_starts=starts,
        )  # fmt: skip

    def _ended(self, status: Status, reason: str = "") -> Compensation:
        alone, chosen = status.physics_only, None
        command = self.q if status is Status.SUCCESS else self.ideal
        lattice = lattice_of(self.whole, self.options.realisable)
        if status.success and lattice and not self.options.single_pass:
            chosen = self._chosen(lattice, command, status)
            command = chosen.joints
            reason = "; ".join(filter(None, (reason, chosen.note)))
        applied = np.zeros(3) if alone else self.error
        pseudo = shifted(self.target, applied)
        if status.success:
            sigma = self.sigma if self.method.learned and not alone else None
            place = ik.position_of(pseudo)
            miss, inside, doubts = judged(
                self.whole, self.method, command, self.context, place, sigma, self.doubtful
            )
            if status is Status.OUT_OF_DOMAIN and inside:
                status = Status.SUCCESS
            reason = "; ".join(filter(None, (reason, *doubts)))
        else:
            miss = ExpectedMiss(np.zeros(3), np.full((3, 3), np.nan))
        return Compensation(
            self.target, self.ideal, applied, miss.sigma, self.inside, pseudo, command,
            self.passes, status, reason, chosen, miss.expected_m, miss.p90_m,
        )  # fmt: skip

    def _chosen(self, lattice: Lattice, joints: np.ndarray, status: Status) -> Realisable:
        """Realisable joints in place of some; what is learned is looked up again where they are."""
        learned = self.predictor if self.method.learned and not status.physics_only else None
        context_at = self.context_at or (lambda _: self.context)

        def tip(q: np.ndarray) -> np.ndarray:
            poses = tip_poses(self.model, q, context_at(q))
            if learned is not None:
                poses[:, :3, 3] += learned.predict(q, self.context).error
            return poses

        free = self.position_only and self.target.ndim == 2
        target = self.target[:3, 3] if free else self.target
        arm = self.model.arm
        locked = ik.locked_joints(self.model, self.options.locked)
        search = Search(characteristic_length(self.model))
        chosen = choose(arm, lattice, tip, target, joints, search, locked=locked)
        self.context = context_at(chosen.joints[None]).take(0)
        if learned is not None:
            expected = learned.predict(chosen.joints[None], self.context)
            self.error = np.asarray(expected.error[0], float)
            self.sigma = np.asarray(expected.sigma[0], float)
        return chosen
