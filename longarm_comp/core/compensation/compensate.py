"""The paper's compensation as one pure function: target -> joints -> expected error -> joints.

One sign: ``error = measured - predicted`` and ``pseudo-target = target - expected error``
(the paper adds "the predicted error" and leaves its sign open; only this one corrects).
The physics sits in the inverse kinematics; the predictor gives what the physics leaves.  The paper
corrects once (`single_pass`); here the pass is repeated until the expected error at the new joints
is the one that was corrected.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
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
    not_known,
    outside_data,
)
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.engines import tip_poses
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
    **given: Any,
) -> Compensation:
    """Joints that bring the *real* tip to one target, (3,) m, (4, 4) or `Frame`, base frame.

    As `compensate_many`; ``context_at`` may give the circumstances at joints (M, n), in which the
    choice among the steps judges each command.
    """
    one = target.matrix() if isinstance(target, Frame) else np.asarray(target, dtype=float)
    if one.shape not in ((3,), (4, 4)):
        raise InputError("compensate", "target", f"shape {one.shape}", "shape (3,) or (4, 4)")
    return compensate_many(model, predictor, one[None], **given)[0]


def compensate_many(
    model: Model,
    predictor: ResidualPredictor | None,
    targets: np.ndarray,
    *,
    context: Context | None = None,
    seed: np.ndarray | None = None,
    position_only: bool = False,
    doubtful: np.ndarray | None = None,
    context_at: _ContextAt | None = None,
    **options: Any,
) -> list[Compensation]:
    """Joints that bring the *real* tip to each of N targets, each by itself.

    Args:
        predictor: the learned residual of the model that the method uses.
        targets: positions (N, 3) in m, or poses (N, 4, 4), base frame.
        context: circumstances in which the arm will stand, of all or of each.
        seed: (n,) or (N, n) current joints; default mid-range.
        doubtful: (n,) joints whose side of arrival the context tells, but not for certain.
        context_at: of one target only, see `compensate`. Default: ``context``.
        options: of `CompensationOptions`.

    Returns:
        Invalid or unreachable targets, and a recorded quantity that an effect of the model needs
        and the context lacks, are reported in `status`, not raised.
    """
    return _Targets(
        model, predictor, targets, context or Context(),
        ik.checked_seed(model, seed, len(targets), "compensate"),
        position_only or targets.ndim == 2, doubtful, context_at, CompensationOptions(**options),
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
    spread, why = not_known(physics, rows, context, doubtful)
    further = (spread**2).reshape(miss.mean.shape)
    said = zip(why, outside_data(physics, rows, context), strict=True)
    doubts = ["; ".join(filter(None, each)) for each in said]
    known = -np.inf if model.uncertainty is None else model.uncertainty.largest_m
    return miss.beside(further), miss.sizes[0] <= known, doubts


def lattice_of(model: Model, realisable: bool | Lattice) -> Lattice | None:
    """Where the servos can stand, by the arm or by steps that were found; None: that is not known,
    or not asked for."""
    if not realisable:
        return None
    lattice = realisable if isinstance(realisable, Lattice) else _lattice(model)
    return lattice if lattice.step.any() else None


def _lattice(model: Model) -> Lattice:
    """Of the steps that a model's arm declares, and of those that its effects have."""
    held: Lattice | None = model.__dict__.get("_lattice")
    if held is None:
        arm, steps = model.arm, model.arm.steps.copy()
        for effect in model.effects:
            if step := effect.step(arm):
                steps[[arm.commanded.index(row) for row in effect.joints]] = step
        held = model.__dict__["_lattice"] = dataclasses.replace(Lattice.of(arm), step=steps)
    return held


@dataclass
class _Targets:
    """N targets on their way: ideal joints, then passes of the pseudo-target."""

    whole: Model
    predictor: ResidualPredictor | None
    target: np.ndarray
    context: Context
    q: np.ndarray
    position_only: bool
    doubtful: np.ndarray | None
    context_at: _ContextAt | None
    options: CompensationOptions

    def __post_init__(self) -> None:
        count, self.method = len(self.target), self.options.method
        self.model, self.ideal = physics_of(self.whole, self.method), self.q.copy()
        self.error, self.sigma = np.zeros((count, 3)), np.full((count, 3), np.nan)
        self.inside, self.passes = np.zeros(count, bool), np.zeros(count, int)
        self.status, self.reason = [Status.SUCCESS] * count, [""] * count

    def reach(self) -> list[Compensation]:
        """Solve for the targets, then correct for the expected error until it settles."""
        ids = np.arange(len(self.target))
        faults = ik.target_faults(self.target, self.position_only, "compensate")
        ids = self._without(ids, Status.BAD_TARGET, {k: f for k, f in enumerate(faults) if f})
        if lacking := missing_column(self.model, self.context):
            ids = self._without(ids, Status.STALE_CONTEXT, dict.fromkeys(ids.tolist(), lacking))
        failed = self._searched(ids, self.target, self.options.starts)
        self.ideal[ids] = self.q[ids]
        ids = self._without(ids, Status.UNREACHABLE, {
            k: other_unit(ik.position_of(self.target[k]), *reach(self.model))
            or missed("target", found)
            for k, found in failed.items()
        })  # fmt: skip
        if self.method.learned and self.predictor is not None:
            self._correct(self.predictor, ids)
        elif self.method.learned:
            self._without(ids, Status.NO_PREDICTOR, dict.fromkeys(ids.tolist(), NO_PREDICTOR))
        return self._ended()

    def _without(self, ids: np.ndarray, status: Status, why: Mapping[int, str]) -> np.ndarray:
        """The targets that go on; some have ended, each for its reason."""
        for k, reason in why.items():
            self.status[k], self.reason[k] = status, reason
        return ids[~np.isin(ids, list(why))] if why else ids

    def _correct(self, predictor: ResidualPredictor, ids: np.ndarray) -> None:
        options = self.options
        while ids.size:
            expected, before = predictor.predict(self.q[ids], self._at(ids)), self.error.copy()
            self.error[ids], self.sigma[ids] = expected.error, expected.sigma
            size, moved = (np.linalg.norm(e, axis=1) for e in (self.error, self.error - before))
            self.inside[ids] = expected.in_domain & np.isfinite(size[ids])
            said = expected.reason or [""] * len(ids)
            ids = self._without(ids, Status.OUT_OF_DOMAIN, {
                k: outside(reason)
                for k, reason in zip(ids.tolist(), said, strict=True) if not self.inside[k]
            })  # fmt: skip
            large = ids[size[ids] > options.max_correction_m].tolist()
            why = {k: options.too_large(size[k]) for k in large}
            ids = self._without(ids, Status.CORRECTION_TOO_LARGE, why)
            ids = ids[(self.passes[ids] == 0) | (moved[ids] > options.tol_m)]
            late = ids[self.passes[ids] == options.max_passes].tolist()
            ids = self._without(ids, Status.NOT_CONVERGED, dict.fromkeys(late, options.unsettled))
            self.passes[ids] += 1
            # A pseudo-target lies next to its target: look near its joints only
            pseudo = shifted(self.target, self.error)
            failed = self._searched(ids, pseudo, min(options.starts, 3))
            why = {k: missed("pseudo-target", found) for k, found in failed.items()}
            ids = self._without(ids, Status.UNREACHABLE, why)
            if options.single_pass:
                return

    def _searched(self, ids: np.ndarray, to: np.ndarray, starts: int) -> dict[int, ik.Solution]:
        """Take the joints that bring the tip to some of (N, ...) places; which fail, and how."""
        given: dict[str, Any] = {
            "position_only": self.position_only, "locked": self.options.locked,
            "max_starts": starts,
        }  # fmt: skip
        if len(ids) == 1:  # quicker than many of one
            k = int(ids[0])
            one = ik.solve(self.model, to[k], seed=self.q[k], context=self._at(ids), **given)
            self.q[k] = one.q
            return {} if one.ok else {k: one}
        if not ids.size:
            return {}
        found = ik.solve_many(self.model, to[ids], seed=self.q[ids], context=self._at(ids), **given)
        self.q[ids] = found.q
        return {int(ids[i]): found[i] for i in np.flatnonzero(~found.ok).tolist()}

    def _at(self, ids: Sequence[int] | np.ndarray) -> Context:
        return self.context.take(np.asarray(ids) if len(ids) > 1 else int(ids[0]))

    def _ended(self) -> list[Compensation]:
        ended = np.array(self.status)
        alone, sent = (np.isin(ended, kinds) for kinds in (_ALONE, [Status.SUCCESS]))
        applied = np.where(alone[:, None], 0.0, self.error)
        command = np.where(sent[:, None], self.q, self.ideal)
        lattice = lattice_of(self.whole, self.options.realisable)
        chosen: dict[int, Realisable] = {}
        if lattice and not self.options.single_pass:
            for k in np.flatnonzero(sent | alone).tolist():
                chosen[k] = self._chosen(lattice, command[k], k, learned=bool(sent[k]))
                command[k] = chosen[k].joints
                applied[k] = self.error[k] * sent[k]
                self.reason[k] = "; ".join(filter(None, (self.reason[k], chosen[k].note)))
        pseudo = shifted(self.target, applied)
        left, sizes = np.full(self.error.shape, np.nan), np.full((2, len(ended)), np.nan)
        for these, learned in ((sent, self.method.learned), (alone, False)):
            ids = np.flatnonzero(these)
            if not ids.size:
                continue
            of = ids if len(ids) > 1 else ids[0]  # one is quicker than an array of one
            miss, inside, doubts = judged(
                self.whole, self.method, command[of], self._at(ids),
                ik.position_of(pseudo)[of], self.sigma[of] if learned else None, self.doubtful,
            )  # fmt: skip
            left[ids], sizes[:, ids] = miss.sigma, np.reshape(miss.sizes, (2, -1))
            for k, known, doubt in zip(ids.tolist(), np.atleast_1d(inside), doubts, strict=True):
                if known and self.status[k] is Status.OUT_OF_DOMAIN:
                    self.status[k] = Status.SUCCESS
                self.reason[k] = "; ".join(filter(None, (self.reason[k], doubt)))
        columns = (
            self.target, self.ideal, applied, left, self.inside.tolist(), pseudo, command,
            self.passes.tolist(), self.status, self.reason, map(chosen.get, range(len(ended))),
            *sizes.tolist(),
        )  # fmt: skip
        return [Compensation(*each) for each in zip(*columns, strict=True)]

    def _chosen(self, lattice: Lattice, joints: np.ndarray, k: int, *, learned: bool) -> Realisable:
        """Realisable joints in place of some; what is learned is looked up again where they are."""
        predictor = self.predictor if self.method.learned and learned else None
        context_at = self.context_at or (lambda _: self._at([k]))

        def tip(q: np.ndarray) -> np.ndarray:
            poses = tip_poses(self.model, q, context_at(q))
            if predictor is not None:
                poses[:, :3, 3] += predictor.predict(q, self._at([k])).error
            return poses

        free = self.position_only and self.target.ndim == 3
        target = self.target[k, :3, 3] if free else self.target[k]
        arm = self.model.arm
        locked = ik.locked_joints(self.model, self.options.locked)
        search = Search(characteristic_length(self.model))
        chosen = choose(arm, lattice, tip, target, joints, search, locked=locked)
        if self.context_at is not None:
            self.context = self.context_at(chosen.joints[None]).take(0)
        if predictor is not None:
            expected = predictor.predict(chosen.joints[None], self._at([k]))
            self.error[k], self.sigma[k] = expected.error[0], expected.sigma[0]
        return chosen


_ALONE = [Status.NO_PREDICTOR, Status.OUT_OF_DOMAIN]
"""The learned error was wanted and is left out."""
