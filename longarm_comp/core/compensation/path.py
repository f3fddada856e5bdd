"""Compensation of a planned path: joints that bring the real tip to all way-points.

Each way-point is solved from its planned joints, without restarts, run-ups or a choice among servo
steps, so joints do not jump where the plan does not.  The history of the joints and the learned
error are computed at the joints found, and these are solved again, until nothing changes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.beyond import outside_data
from longarm_comp.core.compensation.circle import check_no_turn, unwrap
from longarm_comp.core.compensation.compensate import judge, physics_of
from longarm_comp.core.compensation.correction import (
    describe_too_large,
    measure_correction,
    permitted_correction,
)
from longarm_comp.core.compensation.planned_path import (
    PathLimits,
    PlannedPath,
    find_fastest_way,
    retime,
    smooth,
)
from longarm_comp.core.compensation.result import (
    Compensation,
    CompensationOptions,
    Method,
    PathRefused,
    ResidualPredictor,
    Status,
    describe_miss,
    describe_outside,
    guess_unit,
    pseudo_targets,
)
from longarm_comp.core.compensation.take_up import PathLag, Reversal, slow_down, take_up_play
from longarm_comp.core.compensation.unknown import missing_column, unknown_circumstances
from longarm_comp.core.compensation.unshown import unshown_effects
from longarm_comp.core.errors import JobError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.newton import REACHED
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import find_entry, reach
from longarm_comp.core.model.model import Model
from longarm_comp.math.cubic_path import STRAIGHT, CubicPath

ContextAt = Callable[[History], Context]
"""Function that returns the circumstances at all way-points, for the histories (k, n) there, or for
one history (n,) of all."""


@dataclass(frozen=True, eq=False)
class CompensatedPath:
    """A path to send, and the result at each of its k way-points.

    Where the predictor was not used, `error` is zero and `sigma` is NaN.
    """

    timed: CubicPath  # joints, velocities and times to send, of `smooth`
    ideal: np.ndarray  # (k, n) joints without the learned error
    error: np.ndarray  # (k, 3) m, learned error that was corrected
    sigma: np.ndarray  # (k, 3) m, its standard deviation
    context: Context  # circumstances at the way-points
    passes: int  # number of passes of the pseudo-targets
    correction_m: np.ndarray  # (k,) m, of `measure_correction`
    turn_rad: np.ndarray  # (k,) rad, error of orientations that the joints cannot hold
    history: History  # of the joints at the end
    notes: tuple[str, ...]  # doubts, in words

    def each(self, model: Model, method: Method, targets: np.ndarray) -> list[Compensation]:
        """Return one result per way-point, with the error that is expected there.

        The expected error does not hold at a first way-point where the arm stood already.

        Args:
            model, method: with which the path was compensated.
            targets: (k, 3) m or (k, 4, 4), the way-points of the plan.
        """
        pseudo, command = pseudo_targets(targets, self.error), self.timed.joints
        place = ik.position_of(pseudo)
        learned = np.isfinite(self.sigma).all(axis=1)
        made: dict[int, Compensation] = {}
        for with_it in (True, False):
            if not len(rows := np.flatnonzero(learned == with_it)):
                continue
            here, sigma = self.context.take(rows), self.sigma[rows] if with_it else None
            miss, _, doubts = judge(model, method, command[rows], here, place[rows], sigma)
            said = (miss.sigma, doubts, *(size.tolist() for size in miss.sizes))
            for k, spread, doubt, expected, p90 in zip(rows.tolist(), *said, strict=True):
                made[k] = Compensation(
                    target=targets[k],
                    ideal=self.ideal[k],
                    predicted_error=self.error[k],
                    sigma=spread,
                    in_domain=with_it,
                    pseudo_target=pseudo[k],
                    command=command[k],
                    passes=self.passes,
                    status=Status.SUCCESS,
                    reason=doubt,
                    expected_m=expected,
                    p90_m=p90,
                )
        return [made[k] for k in range(len(targets))]


def compensate_path(
    model: Model,
    predictor: ResidualPredictor | None,
    plan: PlannedPath,
    *,
    start: np.ndarray | None,
    history: History,
    context_at: ContextAt,
    seed: np.ndarray | None = None,
    limits: PathLimits | None = None,
    options: CompensationOptions | None = None,
) -> CompensatedPath:
    """Find joints and times that bring the real tip along a planned path.

    If the predictor has no answer for one way-point, it is not used for any, so the path does not
    jump.

    Args:
        predictor: the learned residual of the model that the method uses.
        start: (n,) where the joints stand; None: not known. A plan that has begun begins there.
        history: past motion of the joints, up to ``start``.
        context_at: returns the circumstances at all way-points for the histories there.
        seed: (n,) start of the first search if no joints were planned; ``start`` by default.

    Raises:
        PathRefused: a way-point is no valid target, cannot be reached, needs too large a
            correction, or turns a joint by more than half a turn; a joint stands too far from where
            the plan begins; a limit or a keep-out box is in the way.
        InputError: the plan's shapes or times are not allowed.
    """
    plan.check(model.arm.n)
    options, limits = options or CompensationOptions(), limits or PathLimits()
    limits = replace(limits, position_only=limits.position_only or plan.targets.ndim == 2)
    for row, fault in enumerate(ik.target_faults(plan.targets, limits.position_only, "path")):
        if fault:
            raise PathRefused(Status.BAD_TARGET, row, fault)
    plan = replace(plan, begun=plan.begun and start is not None)
    if plan.joints is not None:
        joints = unwrap(model.arm, plan.joints, start if plan.begun else None)
        plan = replace(plan, joints=joints)
        if plan.begun:
            off = np.abs(np.asarray(start) - joints[0])  # the way from there was not planned
            worst = int(off.argmax())
            if off[worst] > limits.max_start:
                why = f"{model.arm.joint_names[worst]} stands {off[worst]:.3g} from where the plan"
                why = f"{why} begins, allowed {limits.max_start:g}"
                raise PathRefused(Status.CORRECTION_TOO_LARGE, 0, why)
    learned = predictor if options.method.uses_predictor else None
    problem = _PathProblem(model, learned, plan, start, history, context_at, limits, options)
    try:
        return problem.solve(seed)
    except _Unanswered as unanswered:
        made = replace(problem, predictor=None).solve(seed)
        return replace(made, notes=(str(unanswered), *made.notes))


class _Unanswered(Exception):  # noqa: N818
    """The predictor has no answer for a way-point."""


@dataclass(frozen=True, eq=False)
class _PathProblem:
    """A checked plan, and all that its way-points are solved with: arguments of `compensate_path`.

    The plan has begun only if ``start`` is known.
    """

    model: Model
    predictor: ResidualPredictor | None
    plan: PlannedPath
    start: np.ndarray | None
    history: History
    context_at: ContextAt
    limits: PathLimits
    options: CompensationOptions

    @cached_property
    def physics(self) -> Model:
        return physics_of(self.model, self.options.method)

    def solve(self, seed: np.ndarray | None) -> CompensatedPath:
        """Solve the path; repeat until learned error and play are those at the joints found."""
        options, learned = self.options, self.predictor is not None
        play, seeds = PathLag(self.physics, self.limits.turn_m), self._find_seeds(seed)
        error, sigma = np.zeros((len(seeds), 3)), np.full((len(seeds), 3), np.nan)
        context = self._find_context(self.history)  # first as if no joint reversed
        lag = play.compute_lag(seeds, context)
        q, turn = self._find_joints(seeds + lag, error, context)
        bare = q - lag
        if learned:
            error, sigma = self._predict_errors(q, context)
            q, turn = self._find_joints(q, error, context)
        way, passes = q - lag, int(learned)
        while True:
            came = play.find_history(way, lag, self.history, self.start)
            context, used_lag, used_error = self._find_context(came), lag, error
            lag = play.compute_lag(q, context)
            if learned and not options.single_pass:
                error, sigma = self._predict_errors(q, context)
            near = np.maximum(play.tolerance, options.tol_m)
            changes = np.linalg.norm(error - used_error, axis=1) / options.tol_m
            changes = np.maximum(changes, (np.abs(lag - used_lag) / near).max(axis=1))
            if (changes <= 1.0).all():
                break
            if passes == options.max_passes:
                why = options.describe_unsettled()
                raise PathRefused(Status.NOT_CONVERGED, int(np.argmax(changes)), why)
            q, turn = self._find_joints(q - used_lag + lag, error, context)
            passes += 1
        lag = used_lag  # that q was found with
        check_no_turn(self.model.arm, q)
        reversals = play.find_reversals(way, lag, came.approach)
        timed = self._give_times(way, q - lag - way, lag, reversals)
        command = timed.joints
        sizes = measure_correction(self.model, command, self.plan.targets, context)
        self._refuse_too_large(int(np.argmax(sizes)), float(sizes.max()))
        if self.model.arm.keep_out:
            times = timed.chords(STRAIGHT)
            k, entry = find_entry(declared_model(self.model.arm), timed.at(times))
            if entry:
                row = int(np.searchsorted(timed.times, times[k]))
                raise PathRefused(Status.KEPT_OUT, row, entry)
        first = int(self.plan.begun)
        came = self.history.along(command, command[0] if first else self.start)
        notes: list[str] = []
        if len(command) > first:  # else the arm stands there already
            # Doubts: unknown circumstances at the beginning, and way-points outside the data
            begins, rest = slice(first, first + 1), slice(first, None)
            notes = [
                *unknown_circumstances(self.physics, command[begins], context.take(begins))[1],
                *outside_data(self.physics, command[rest], context.take(rest))[1],
                *unshown_effects(self.physics, command[begins], context.take(begins))[1],
            ]
        if turn[worst := int(np.argmax(turn))] > REACHED:
            off = f"up to {np.degrees(turn[worst]):.2g} deg, at way-point {worst}"
            notes.insert(0, f"the joints cannot hold the orientation: it is off by {off}")
        return CompensatedPath(
            timed=timed,
            ideal=self._begin_where_it_stands(bare + lag) if learned else command,
            error=used_error,
            sigma=sigma,
            context=context,
            passes=passes,
            correction_m=sizes,
            turn_rad=turn,
            history=History(came.approach[-1], came.legs[-1], came.last_way[-1]),
            notes=tuple(dict.fromkeys(filter(None, notes))),
        )

    def _refuse_too_large(self, row: int, size_m: float) -> None:
        most_m = permitted_correction(self.model, self.options.max_correction_m)
        if size_m > most_m:
            why = describe_too_large(size_m, most_m)
            raise PathRefused(Status.CORRECTION_TOO_LARGE, row, why)

    def _give_times(
        self, way: np.ndarray, off: np.ndarray, lag: np.ndarray, reversals: list[Reversal]
    ) -> CubicPath:
        """Return the path to send, timed within the limits; `take_up_play` has the arguments."""
        plan, arm = self.plan, self.model.arm
        planned = np.arange(float(len(way))) if plan.times is None else plan.times
        begun = self._begin_where_it_stands(way + off + lag)[:2]
        first = np.diff((way if plan.joints is None else plan.joints)[:2], axis=0).sum(axis=0)
        begins = np.diff(begun, axis=0).sum(axis=0) - first
        second = min(1, len(way) - 1)

        def commands(times: np.ndarray) -> CubicPath:
            stands, beyond = take_up_play(way, off, lag, reversals, times)
            stands[0] = stands[second] - first  # the rest of the first step counts as beyond
            beyond[0] = begun[0] - stands[0]
            return smooth(plan, planned, times, stands, beyond, arm.bounds)

        bare = np.vstack([way[second] - first, way[1:]])
        unit = arm.upper - arm.lower
        times = slow_down(planned, bare, unit, begins, reversals, self.limits.max_longer, commands)
        try:
            motion = self.limits.motion
            if motion is None:
                return commands(times)
            limited = np.isfinite([motion.velocity, motion.acceleration]).all()
            if plan.times is None and limited and len(way) > 1:
                return find_fastest_way(commands(times).joints, motion)
            return retime(commands(times), motion)
        except JobError as error:
            raise PathRefused(Status.NOT_CONVERGED, 0, str(error)) from None

    def _find_context(self, came: History) -> Context:
        context = self.context_at(came)
        if lacking := missing_column(self.physics, context):
            raise PathRefused(Status.STALE_CONTEXT, 0, lacking)
        return context

    def _find_seeds(self, seed: np.ndarray | None) -> np.ndarray:
        """Return joints (k, n) to start from: the planned ones, else solved one after the other."""
        arm, plan = self.model.arm, self.plan
        if plan.joints is not None:
            return self._begin_where_it_stands(np.clip(plan.joints, *arm.bounds))
        each, physics = self._find_context(self.history).each(len(plan.targets)), self.physics
        made: list[np.ndarray] = []
        first = self.start if seed is None else seed
        for row, (target, context) in enumerate(zip(plan.targets, each, strict=True)):
            found = ik.solve(
                physics,
                target,
                seed=made[-1] if made else first,
                context=context,
                position_only=self.limits.position_only,
                near=True,
                locked=self.options.locked,
                max_starts=1 if made else self.options.starts,
            )
            self._refuse_unreached(row, found)
            made.append(found.q)
        return self._begin_where_it_stands(np.array(made))

    def _begin_where_it_stands(self, q: np.ndarray) -> np.ndarray:
        """Replace the first of joints (k, n) by where the arm stands, if the path has begun."""
        if self.plan.begun:
            q[0] = self.start
        return q

    def _find_joints(
        self, seeds: np.ndarray, error: np.ndarray, context: Context
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find joints (k, n) for the targets less an error (k, 3), m, from seeds (k, n).

        The orientation error (k,), rad, comes second.
        """
        found = ik.solve_many(
            self.physics,
            pseudo_targets(self.plan.targets, error),
            seed=seeds,
            context=context,
            position_only=self.limits.position_only,
            near=True,
            locked=self.options.locked,
            max_starts=1,
        )
        turn = found.angle_residual_rad
        turn[: int(self.plan.begun)] = 0.0  # the arm stands there already
        for row in np.flatnonzero(~found.ok | (turn > self.limits.max_turn_rad)).tolist():
            if row or not self.plan.begun:
                self._refuse_unreached(row, found[row])
        return self._begin_where_it_stands(found.q), turn

    def _refuse_unreached(self, row: int, found: ik.Solution) -> None:
        """Raise PathRefused if a way-point was not reached or its orientation is too far off."""
        if not found.ok:
            here = ik.position_of(self.plan.targets[row])
            why = guess_unit(here, *reach(self.physics)) or describe_miss("target", found)
            raise PathRefused(Status.UNREACHABLE, row, why)
        if found.angle_residual_rad > self.limits.max_turn_rad:
            off = f"its orientation would be off by {found.angle_residual_rad:.3g} rad"
            why = f"{off}, allowed {self.limits.max_turn_rad:g} rad; position_only leaves it free"
            raise PathRefused(Status.UNREACHABLE, row, why)

    def _predict_errors(self, q: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Return the learned error and its sigma, (k, 3) m each, at joints (k, n)."""
        error, sigma = np.zeros((len(q), 3)), np.full((len(q), 3), np.nan)
        assert self.predictor is not None
        for row in range(int(self.plan.begun), len(q)):
            found = self.predictor.predict(q[row : row + 1], context.take(row))
            error[row], sigma[row] = found.error[0], found.sigma[0]
            size = float(np.linalg.norm(error[row]))
            if not found.in_domain[0] or not np.isfinite(size):
                why = describe_outside(*found.reason[:1])
                raise _Unanswered(f"physics only, as way-point {row} is {why}")
            self._refuse_too_large(row, size)
        return error, sigma
