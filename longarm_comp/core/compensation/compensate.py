"""The paper's compensation as one pure function: target -> joints -> expected error -> joints.

Signs: ``error = measured - predicted`` and ``pseudo-target = target - expected error``
(the paper adds "the predicted error" and leaves its sign open; only this sign corrects).
The physics is part of the inverse kinematics; the predictor gives the error that the physics
leaves.  The paper corrects once (`single_pass`). Here the pass is repeated until the expected error
at the new joints is the one that was corrected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.beyond import outside_data
from longarm_comp.core.compensation.correction import (
    describe_too_large,
    measure_correction,
    permitted_correction,
)
from longarm_comp.core.compensation.expected import ExpectedMiss, expected_miss
from longarm_comp.core.compensation.realisable import Lattice, Realisable, Search, choose
from longarm_comp.core.compensation.result import (
    Compensation,
    CompensationOptions,
    Method,
    ResidualPredictor,
    Status,
    describe_miss,
    describe_outside,
    guess_unit,
    pseudo_targets,
)
from longarm_comp.core.compensation.unknown import missing_column, unknown_circumstances
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.engines import tip_poses
from longarm_comp.core.ik.kernel import characteristic_length
from longarm_comp.core.model.link_frames import reach
from longarm_comp.core.model.model import Model
from longarm_comp.math.points import lengths


def physics_of(model: Model, method: Method) -> Model:
    """Return the model that a method's inverse kinematics uses: with effects, or rigid."""
    return model.commandable if method.uses_physics else model.rigid


def compensate(
    model: Model,
    predictor: ResidualPredictor | None,
    targets: np.ndarray,
    *,
    context: Context | None = None,
    seed: np.ndarray | None = None,
    position_only: bool = False,
    doubtful: np.ndarray | None = None,
    context_at: Callable[[np.ndarray], Context] | None = None,
    **options: Any,
) -> list[Compensation]:
    """Find joints that bring the *real* tip to each of N independent targets.

    Args:
        predictor: the learned residual of the model that the method uses.
        targets: positions (N, 3) in m, or poses (N, 4, 4), base frame; or a single one.
        context: circumstances in which the arm will stand, of all or of each.
        seed: (n,) or (N, n) current joints; default mid-range.
        position_only: leave the orientation free.
        doubtful: (n,) bool, joints whose side of arrival in the context is not certain.
        context_at: only for a single target: returns the circumstances at joints (M, n). The choice
            among the servos' steps judges each command in these. Default: ``context``.
        options: fields of `CompensationOptions`.

    Returns:
        One result per target. Invalid or unreachable targets, and circumstances that an effect of
        the model needs and the context lacks, are reported in its `status`, not raised.
    """
    settings, to = CompensationOptions(**options), np.asarray(targets, dtype=float)
    if to.shape in ((3,), (4, 4)):
        to = to[None]
    batch = _Batch(
        model=model,
        predictor=predictor if settings.method.uses_predictor else None,
        target=to,
        q=ik.checked_seed(model, seed, len(to), "compensate"),
        context=context or Context(),
        position_only=position_only or to.ndim == 2,
        context_at=context_at,
        options=settings,
    )
    batch.correct(batch.solve_ideal())
    batch.refuse_too_large()
    lattice = lattice_of(model, settings.realisable)
    if lattice is not None and not settings.single_pass:
        batch.choose_steps(lattice)
    return batch.make_results(doubtful)


def judge(
    model: Model,
    method: Method,
    command: np.ndarray,
    context: Context,
    pseudo: np.ndarray,
    sigma: np.ndarray | None,
    doubtful: np.ndarray | None = None,
) -> tuple[ExpectedMiss, np.ndarray, list[str]]:
    """Estimate how far the tip may be from its target at one command, or at each of M.

    Args:
        command: (n,) or (M, n) joints.
        context: circumstances of all, or of each.
        pseudo: (..., 3) m, the position to which the physics should bring the tip.
        sigma: (..., 3) m, standard deviation of the learned error that was subtracted; None if no
            error was.
        doubtful: as in `compensate`.

    Returns:
        The expected miss; (...) bool, whether the model's part of it is no larger than at the
        fitted rows; and the doubts about each command, in words.
    """
    physics = physics_of(model, method)
    whole = sigma is None and not missing_column(model, context)
    miss = expected_miss(model if whole else physics, command, context, pseudo, sigma)
    largest = -np.inf if model.uncertainty is None else model.uncertainty.largest_m
    is_known = miss.sizes[0] <= largest
    rows = np.atleast_2d(command)
    spread, why = unknown_circumstances(physics, rows, context, doubtful)
    beyond, outside = outside_data(physics, rows, context)
    if spread.any() or beyond.any():
        miss = miss.plus((spread**2 + beyond**2).reshape(miss.mean.shape))
    said = zip(why, outside, strict=True)
    return miss, is_known, ["; ".join(filter(None, each)) for each in said]


def lattice_of(model: Model, realisable: bool | Lattice) -> Lattice | None:
    """Return the values at which the servos can stand; None if unknown or not to be used.

    Args:
        realisable: True: the steps of the arm and of its effects; or a lattice; False: none.
    """
    if not realisable:
        return None
    if isinstance(realisable, Lattice):
        return realisable if realisable.step.any() else None
    arm, steps = model.arm, model.arm.steps.copy()
    for effect in model.effects:
        if step := effect.step(arm):
            steps[[arm.commanded.index(row) for row in effect.joints]] = step
    return Lattice(steps, *np.zeros((2, arm.n))) if steps.any() else None


@dataclass
class _Batch:
    """N targets that are solved side by side: ideal joints, then passes of the pseudo-target.

    Attributes:
        predictor: None if the method uses none, or there is none.
        target: (N, 3) or (N, 4, 4).
        q: (N, n) joints found last.
        ideal: (N, n) joints by physics alone.
        error, sigma: (N, 3) m, learned error and its sigma at the joints of the last prediction.
        in_domain: (N,) whether the predictor was inside its domain.
        passes: (N,) number of passes of the pseudo-target.
        status, reason: outcome of each target. A target without success was given up, or is
            compensated without the learned error.
        chosen: choice among the servos' steps, by target number.
    """

    model: Model
    predictor: ResidualPredictor | None
    target: np.ndarray
    q: np.ndarray
    context: Context
    position_only: bool
    context_at: Callable[[np.ndarray], Context] | None
    options: CompensationOptions
    chosen: dict[int, Realisable] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count, self.method = len(self.target), self.options.method
        self.physics, self.ideal = physics_of(self.model, self.method), self.q
        self.error, self.sigma = np.zeros((count, 3)), np.full((count, 3), np.nan)
        self.in_domain, self.passes = np.zeros(count, bool), np.zeros(count, int)
        self.status, self.reason = [Status.SUCCESS] * count, [""] * count
        self.most_m = permitted_correction(self.model, self.options.max_correction_m)

    def solve_ideal(self) -> list[int]:
        """Find the joints by physics alone; return the numbers of the targets that were reached."""
        faults = ik.target_faults(self.target, self.position_only, "compensate")
        lacking = missing_column(self.physics, self.context)
        for k, fault in enumerate(faults):
            if fault:
                self.status[k], self.reason[k] = Status.BAD_TARGET, fault
            elif lacking:
                self.status[k], self.reason[k] = Status.STALE_CONTEXT, lacking
        valid = self._list_rows(Status.SUCCESS)
        for k, found in self._search(valid, self.target, self.options.starts).items():
            unit = guess_unit(ik.position_of(self.target[k]), *reach(self.physics))
            self.status[k] = Status.UNREACHABLE
            self.reason[k] = unit or describe_miss("target", found)
        self.ideal = self.q.copy()
        return self._list_rows(Status.SUCCESS)

    def correct(self, going: list[int]) -> None:
        """Solve pseudo-targets until the expected error is that at the joints found.

        Args:
            going: numbers of the targets to correct.
        """
        options = self.options
        if self.predictor is None:
            for k in going if self.method.uses_predictor else ():
                self.status[k] = Status.NO_PREDICTOR
                self.reason[k] = "no predictor: compensated with physics only"
            return
        for passes in range(options.max_passes + 1 if going else 0):
            here = _index_of(going)
            found = self.predictor.predict(self.q[here], self._context_of(going))
            size, change = lengths(found.error), lengths(found.error - self.error[here])
            inside = found.in_domain & np.isfinite(size)
            self.error[here], self.sigma[here] = found.error, found.sigma
            self.in_domain[here] = inside
            reasons = found.reason or [""] * len(going)
            each = zip(going, size.tolist(), change.tolist(), inside.tolist(), reasons, strict=True)
            unsettled = []
            for k, size_m, change_m, is_inside, why in each:
                if not is_inside:
                    self.status[k], self.reason[k] = Status.OUT_OF_DOMAIN, describe_outside(why)
                elif size_m > self.most_m:
                    self.status[k] = Status.CORRECTION_TOO_LARGE
                    self.reason[k] = describe_too_large(size_m, self.most_m)
                elif passes and change_m <= options.tol_m:
                    continue
                elif passes == options.max_passes:
                    self.status[k] = Status.NOT_CONVERGED
                    self.reason[k] = options.describe_unsettled()
                else:
                    unsettled.append(k)
            if not unsettled:
                return
            # A pseudo-target lies next to its target: look near its joints only
            pseudo = pseudo_targets(self.target, self.error)
            failed = self._search(unsettled, pseudo, min(options.starts, 3))
            self.passes[_index_of(unsettled)] += 1
            for k, missed in failed.items():
                self.status[k] = Status.UNREACHABLE
                self.reason[k] = describe_miss("pseudo-target", missed)
            going = [k for k in unsettled if k not in failed]
            if options.single_pass or not going:
                return

    def refuse_too_large(self) -> None:
        """Give up the targets whose whole correction is larger than permitted."""
        each = (Status.SUCCESS,), _PHYSICS_ONLY
        for status, q in zip(each, (self.q, self.ideal), strict=True):
            if not (rows := self._list_rows(*status)):
                continue
            here, context = _index_of(rows), self._context_of(rows)
            sizes = measure_correction(self.model, q[here], self.target[here], context)
            for k, size_m in zip(rows, sizes.tolist(), strict=True):
                if size_m > self.most_m:
                    self.status[k] = Status.CORRECTION_TOO_LARGE
                    self.reason[k] = describe_too_large(size_m, self.most_m)

    def choose_steps(self, lattice: Lattice) -> None:
        """Choose the joints to send among those at which the servos can stand."""
        search = Search(characteristic_length(self.physics))
        locked = ik.locked_joints(self.physics, self.options.locked)
        for k in self._list_rows(Status.SUCCESS, *_PHYSICS_ONLY):
            sent, target = self.status[k] is Status.SUCCESS, self.target[k]
            chosen = self.chosen[k] = choose(
                self.model.arm,
                lattice,
                partial(self._predict_tip, k, learned=sent),
                ik.position_of(target) if self.position_only else target,
                self.q[k] if sent else self.ideal[k],
                search,
                locked=locked,
            )
            if self.context_at is not None:
                self.context = self.context_at(chosen.joints[None]).take(0)
            if sent and self.predictor is not None:  # predicted anew at the chosen joints
                expected = self.predictor.predict(chosen.joints[None], self._context_of([k]))
                self.error[k], self.sigma[k] = expected.error[0], expected.sigma[0]

    def _predict_tip(self, k: int, q: np.ndarray, learned: bool) -> np.ndarray:
        """Predict the tip's poses (M, 4, 4) at joints (M, n) in the circumstances of target k.

        Args:
            learned: whether to add the learned error.
        """
        here = self._context_of([k])
        context = here if self.context_at is None else self.context_at(q)
        poses = tip_poses(self.physics, q, context)
        if learned and self.predictor is not None:
            poses[:, :3, 3] += self.predictor.predict(q, here).error
        return poses

    def make_results(self, doubtful: np.ndarray | None) -> list[Compensation]:
        """Return the result of each target, with its expected error.

        Args:
            doubtful: as in `compensate`.
        """
        count, status, reason = len(self.target), self.status, self.reason
        sent, alone = self._list_rows(Status.SUCCESS), self._list_rows(*_PHYSICS_ONLY)
        command, error = self.ideal.copy(), self.error.copy()
        command[sent], error[alone] = self.q[sent], 0.0
        for k, realisable in self.chosen.items():
            command[k] = realisable.joints
            reason[k] = "; ".join(filter(None, (reason[k], realisable.note)))
        pseudo = pseudo_targets(self.target, error)
        sigma, sizes = np.full((count, 3), np.nan), np.full((2, count), np.nan)
        for rows, learned in ((sent, self.method.uses_predictor), (alone, False)):
            if not rows:
                continue
            of: Any = rows if len(rows) > 1 else rows[0]  # one is quicker than an array of one
            miss, known, doubts = judge(
                self.model,
                self.method,
                command[of],
                self._context_of(rows),
                ik.position_of(pseudo)[of],
                self.sigma[of] if learned else None,
                doubtful,
            )
            sigma[of] = miss.sigma
            sizes[0, of], sizes[1, of] = miss.sizes
            for k, is_known, doubt in zip(rows, np.atleast_1d(known), doubts, strict=True):
                if is_known and status[k] is Status.OUT_OF_DOMAIN:
                    status[k] = Status.SUCCESS
                reason[k] = "; ".join(filter(None, (reason[k], doubt)))
        in_domain, passes = self.in_domain.tolist(), self.passes.tolist()
        expected_m, p90_m = sizes.tolist()
        return [
            Compensation(
                target=self.target[k],
                ideal=self.ideal[k],
                predicted_error=error[k],
                sigma=sigma[k],
                in_domain=in_domain[k],
                pseudo_target=pseudo[k],
                command=command[k],
                passes=passes[k],
                status=status[k],
                reason=reason[k],
                realisable=self.chosen.get(k),
                expected_m=expected_m[k],
                p90_m=p90_m[k],
            )
            for k in range(count)
        ]

    def _search(self, rows: list[int], to: np.ndarray, starts: int) -> dict[int, ik.Solution]:
        """Find and store joints for some of N targets; return the failed searches by target number.

        Args:
            rows: numbers of the targets to search for.
            to: (N, 3) or (N, 4, 4): where the tip must be by the physical model.
            starts: largest number of starts of each search.
        """
        locked, free = self.options.locked, self.position_only
        given: dict[str, Any] = {"position_only": free, "locked": locked, "max_starts": starts}
        if len(rows) == 1:  # quicker than many of one
            k, here = rows[0], self._context_of(rows)
            one = ik.solve(self.physics, to[k], seed=self.q[k], context=here, **given)
            self.q[k] = one.q
            return {} if one.ok else {k: one}
        if not rows:
            return {}
        here = self._context_of(rows)
        found = ik.solve_many(self.physics, to[rows], seed=self.q[rows], context=here, **given)
        self.q[rows] = found.q
        return {rows[i]: found[i] for i in np.flatnonzero(~found.ok).tolist()}

    def _list_rows(self, *status: Status) -> list[int]:
        return [k for k, each in enumerate(self.status) if each in status]

    def _context_of(self, rows: Sequence[int]) -> Context:
        return self.context.take(np.asarray(rows) if len(rows) > 1 else rows[0])


def _index_of(rows: list[int]) -> list[int] | slice:
    """Return an index of rows. For a single row it is a slice, which is faster than a list."""
    return rows if len(rows) > 1 else slice(rows[0], rows[0] + 1)


_PHYSICS_ONLY = (Status.NO_PREDICTOR, Status.OUT_OF_DOMAIN)
"""Outcomes in which the learned error is left out although the method uses it."""
