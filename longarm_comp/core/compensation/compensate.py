"""The paper's compensation as one pure function: target -> joints -> expected error -> joints.

Signs: ``error = measured - predicted`` and ``pseudo-target = target - expected error``
(the paper adds "the predicted error" and leaves its sign open; only this sign corrects).
The physics is part of the inverse kinematics; the predictor gives the error that the physics
leaves.  The paper corrects once (`single_pass`). Here the pass is repeated until the expected error
at the new joints is the one that was corrected.
"""

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
from longarm_comp.core.compensation.unshown import unshown_effects
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
        options: fields of `CompensationOptions`.

    Returns:
        One result per target. Invalid or unreachable targets, and circumstances that an effect of
        the model needs and the context lacks, are reported in its `status`, not raised.
    """
    to = np.asarray(targets, dtype=float)
    if to.shape in ((3,), (4, 4)):
        to = to[None]
    known, settings = context or Context(), CompensationOptions(**options)
    found = SolvedTargets(model, predictor, to, known, seed, position_only, settings)
    return found.judge_each(doubtful)


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
    covariance, unshown = unshown_effects(physics, rows, context)
    covariance += (spread**2 + beyond**2)[..., None] * np.eye(3)
    if covariance.any():
        miss = miss.plus(covariance.reshape(miss.covariance.shape))
    said = zip(why, outside, unshown, strict=True)
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
class SolvedTargets:
    """N targets that are solved side by side: ideal joints, then passes of the pseudo-target.

    Other attributes are arguments of `compensate`.

    Attributes:
        predictor: None if the method uses none, or there is none.
        target: (N, 3) or (N, 4, 4).
        context_at: only for a single target: returns the circumstances at joints (M, n). The choice
            among the servos' steps judges each command in these. Default: `context`.
        q: (N, n) joints found last; `ideal` where a target was given up, or is compensated without
            the learned error.
        ideal: (N, n) joints by physics alone.
        error, sigma: (N, 3) m, learned error and its sigma at the joints of the last prediction.
        in_domain: (N,) whether the predictor was inside its domain.
        passes: (N,) number of passes of the pseudo-target.
        chosen: choice among the servos' steps, by target number.
    """

    model: Model
    predictor: ResidualPredictor | None
    target: np.ndarray
    context: Context
    seed: np.ndarray | None
    position_only: bool
    options: CompensationOptions
    context_at: Callable[[np.ndarray], Context] | None = None
    chosen: dict[int, Realisable] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count, self.method = len(self.target), self.options.method
        self.q = ik.checked_seed(self.model, self.seed, count, "compensate")
        self.position_only |= self.target.ndim == 2
        self.physics, self.ideal = physics_of(self.model, self.method), self.q
        self.error, self.sigma = np.zeros((count, 3)), np.full((count, 3), np.nan)
        self.in_domain, self.passes = np.zeros(count, bool), np.zeros(count, int)
        self.status, self.reason = [Status.SUCCESS] * count, [""] * count
        self.most_m = permitted_correction(self.model, self.options.max_correction_m)
        if not self.method.uses_predictor:
            self.predictor = None
        self._solve_ideal()
        self._correct()
        self._refuse_too_large()
        lattice = lattice_of(self.model, self.options.realisable)
        if lattice is not None and not self.options.single_pass:
            self._choose_steps(lattice)

    def _solve_ideal(self) -> None:
        """Find the joints by physics alone."""
        faults = ik.target_faults(self.target, self.position_only, "compensate")
        lacking = missing_column(self.physics, self.context)
        for k, fault in enumerate(faults):
            if fault:
                self._end(k, Status.BAD_TARGET, fault)
            elif lacking:
                self._end(k, Status.STALE_CONTEXT, lacking)
        valid = self._list_successful()
        for k, found in self._search(valid, self.target, self.options.starts).items():
            unit = guess_unit(ik.position_of(self.target[k]), *reach(self.physics))
            self._end(k, Status.UNREACHABLE, unit or describe_miss("target", found))
        self.ideal = self.q.copy()

    def _correct(self) -> None:
        """Solve pseudo-targets until the expected error is that at the joints found."""
        options, going = self.options, self._list_successful()
        if self.predictor is None:
            for k in going if self.method.uses_predictor else ():
                self._end(k, Status.NO_PREDICTOR, "no predictor: compensated with physics only")
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
                    self._end(k, Status.OUT_OF_DOMAIN, describe_outside(why))
                elif size_m > self.most_m:
                    self._end(
                        k, Status.CORRECTION_TOO_LARGE, describe_too_large(size_m, self.most_m)
                    )
                elif passes and change_m <= options.tol_m:
                    continue
                elif passes == options.max_passes:
                    self._end(k, Status.NOT_CONVERGED, options.describe_unsettled())
                else:
                    unsettled.append(k)
            if not unsettled:
                return
            # A pseudo-target lies next to its target: look near its joints only
            pseudo = pseudo_targets(self.target, self.error)
            failed = self._search(unsettled, pseudo, min(options.starts, 3))
            self.passes[_index_of(unsettled)] += 1
            for k, missed in failed.items():
                self._end(k, Status.UNREACHABLE, describe_miss("pseudo-target", missed))
            going = [k for k in unsettled if k not in failed]
            if options.single_pass or not going:
                return

    def _refuse_too_large(self) -> None:
        """Give up the targets whose whole correction is larger than permitted."""
        if not (rows := self._list_successful()):
            return
        here, context = _index_of(rows), self._context_of(rows)
        sizes = measure_correction(self.model, self.q[here], self.target[here], context)
        for k, size_m in zip(rows, sizes.tolist(), strict=True):
            if size_m > self.most_m:
                self._end(k, Status.CORRECTION_TOO_LARGE, describe_too_large(size_m, self.most_m))

    def _choose_steps(self, lattice: Lattice) -> None:
        """Choose the joints to send among those at which the servos can stand."""
        search = Search(characteristic_length(self.physics))
        locked = ik.locked_joints(self.physics, self.options.locked)
        for k in self._list_successful():
            target = ik.position_of(self.target[k]) if self.position_only else self.target[k]
            predictor = self.predictor if self.status[k] is Status.SUCCESS else None
            predict = partial(self._predict_tip, self._context_of([k]), predictor)
            chosen = self.chosen[k] = choose(
                self.model.arm, lattice, predict, target, self.q[k], search, locked=locked
            )
            self.q[k] = chosen.joints
            if self.context_at is not None:
                self.context = self.context_at(chosen.joints[None]).take(0)
            if predictor is not None:  # predicted anew at the chosen joints
                expected = predictor.predict(chosen.joints[None], self._context_of([k]))
                self.error[k], self.sigma[k] = expected.error[0], expected.sigma[0]

    def _predict_tip(
        self, here: Context, predictor: ResidualPredictor | None, q: np.ndarray
    ) -> np.ndarray:
        """Predict the tip's poses (M, 4, 4) at joints (M, n) that are tried for one target."""
        poses = tip_poses(self.physics, q, self.context_at(q) if self.context_at else here)
        if predictor is not None:
            poses[:, :3, 3] += predictor.predict(q, here).error
        return poses

    def judge_each(self, doubtful: np.ndarray | None) -> list[Compensation]:
        """Return the result of each target, with the error that is expected of it.

        Args:
            doubtful: as in `compensate`.
        """
        status, reason = self.status, self.reason
        for k, realisable in self.chosen.items():
            reason[k] = "; ".join(filter(None, (reason[k], realisable.note)))
        pseudo = pseudo_targets(self.target, self.error)
        sigma, sizes = np.full_like(self.sigma, np.nan), np.full((2, len(self.q)), np.nan)
        success = self._list_successful()
        sent = [k for k in success if status[k] is Status.SUCCESS]
        alone = [k for k in success if status[k] is not Status.SUCCESS]
        for rows, learned in ((sent, self.method.uses_predictor), (alone, False)):
            if not rows:
                continue
            of: Any = rows if len(rows) > 1 else rows[0]  # one is quicker than an array of one
            miss, known, doubts = judge(
                self.model,
                self.method,
                self.q[of],
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
                predicted_error=self.error[k],
                sigma=sigma[k],
                in_domain=in_domain[k],
                pseudo_target=pseudo[k],
                command=self.q[k],
                passes=passes[k],
                status=status[k],
                reason=reason[k],
                realisable=self.chosen.get(k),
                expected_m=expected_m[k],
                p90_m=p90_m[k],
            )
            for k in range(len(self.q))
        ]

    def _search(self, rows: list[int], to: np.ndarray, starts: int) -> dict[int, ik.Solution]:
        """Find and store joints for some of N targets; return the failed searches by target number.

        Args:
            rows: numbers of the targets to search for.
            to: (N, 3) or (N, 4, 4): where the tip must be by the physical model.
            starts: largest number of starts of each search.
        """
        if not rows:
            return {}
        here, options = self._context_of(rows), self.options
        given: dict[str, Any] = {"locked": options.locked, "max_starts": starts, "context": here}
        given["position_only"] = self.position_only
        if len(rows) == 1:  # quicker than many of one
            k = rows[0]
            one = ik.solve(self.physics, to[k], seed=self.q[k], **given)
            self.q[k] = one.q
            return {} if one.ok else {k: one}
        found = ik.solve_many(self.physics, to[rows], seed=self.q[rows], **given)
        self.q[rows] = found.q
        return {rows[i]: found[i] for i in np.flatnonzero(~found.ok).tolist()}

    def _end(self, k: int, status: Status, reason: str) -> None:
        """Give up target k, or compensate it without the learned error."""
        self.status[k], self.reason[k], self.q[k] = status, reason, self.ideal[k]
        if status.success:
            self.error[k] = 0.0

    def _list_successful(self) -> list[int]:
        return [k for k, status in enumerate(self.status) if status.success]

    def _context_of(self, rows: Sequence[int]) -> Context:
        return self.context.take(np.asarray(rows) if len(rows) > 1 else rows[0])


def _index_of(rows: list[int]) -> list[int] | slice:
    """Return an index of rows. For a single row it is a slice, which is faster than a list."""
    return rows if len(rows) > 1 else slice(rows[0], rows[0] + 1)
