"""Computes joint commands that bring the real tip to targets."""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.circumstances import check_circumstance
from longarm_comp.core.arm.context import PER_JOINT, Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.arm.moves import Move
from longarm_comp.core.compensation.arrive import Arrival, compensate_move
from longarm_comp.core.compensation.compensate import compensate as compensate_each
from longarm_comp.core.compensation.compensate import physics_of
from longarm_comp.core.compensation.realisable import Lattice
from longarm_comp.core.compensation.result import Compensation, CompensationOptions, Method, Status
from longarm_comp.core.compensation.target_frame import Placement, find_placement
from longarm_comp.core.compensation.unknown import sided_joints
from longarm_comp.core.data.measured_rows import array_of
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.html_table import html_table
from longarm_comp.core.identify.run_ups import with_fitted_run_ups
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import XYZ, joint_names
from longarm_comp.sessions.read import read_session
from longarm_comp.sessions.table import WriteTable, write_table
from longarm_comp.sessions.targets import Targets
from longarm_comp.workflows.inputs import FilePath, SessionLike, check_predictor


@dataclass(frozen=True, eq=False, repr=False)
class Commands(Sequence[Compensation]):
    """A sequence of the results for N targets, in their order.

    Attributes:
        numbers: (N,) number of each target.
        arrivals: result of each target and the move for which it holds, in the frame of the model.
            For a calibrated model that is the frame of the measurements.
        placements: frame of each target, and its pose in the frame of the model.
    """

    numbers: np.ndarray
    arrivals: tuple[Arrival, ...]
    placements: tuple[Placement, ...]

    def __len__(self) -> int:
        return len(self.arrivals)

    @property
    def results(self) -> tuple[Compensation, ...]:
        """The result of each target."""
        return tuple(each.outcome for each in self.arrivals)

    def __getitem__(self, k: Any) -> Any:
        return self.results[k]

    @property
    def command(self) -> np.ndarray:
        """(N, n) joints to send, rad and m; not valid where `success` is False."""
        return np.array([each.command for each in self.results])

    @property
    def status(self) -> tuple[Status, ...]:
        """The status of each target."""
        return tuple(each.status for each in self.results)

    @property
    def success(self) -> np.ndarray:
        """(N,) whether the command may be sent."""
        return np.array([each.success for each in self.results])

    @property
    def summary(self) -> str:
        """Number of targets by status, in one line."""
        counts = Counter(status.name.lower() for status in self.status)
        return f"{len(self)} targets: " + ", ".join(f"{n} {name}" for name, n in counts.items())

    @property
    def frames(self) -> list[str]:
        """List the frames of the targets and the placements used, one line for each that occurs."""
        return list(dict.fromkeys(each.text for each in self.placements))

    @property
    def promise(self) -> str:
        """The expected error of the commands, in words; empty where none is known."""
        good = [each for each in self.results if each.success and np.isfinite(each.expected_m)]
        if not good:
            return ""
        expected = 1e3 * max(each.expected_m for each in good)
        within = 1e3 * max(each.p90_m for each in good)
        return f"; expected error up to {expected:.2f} mm, 90 % within {within:.2f} mm"

    def _repr_html_(self) -> str:
        rows = [
            {
                "target": int(number),
                "status": each.status.name.lower(),
                "expected, mm": 1e3 * float(each.expected_m),
                "90 %, mm": 1e3 * float(each.p90_m),
                **{f"q{j}": float(q) for j, q in enumerate(each.command, 1)},
            }
            for number, each in zip(self.numbers, self, strict=True)
        ]
        return html_table(f"{self.summary}{self.promise}", rows)

    def __repr__(self) -> str:
        return f"Commands({self.summary}{self.promise})"

    def lines(self) -> list[dict[str, Any]]:
        """Return the lines of commands.csv, by column; positions are in the frame of the target.

        A value is None if it is not known or the target failed.
        """
        rows = zip(self.numbers, self.arrivals, self.placements, strict=True)
        return [_line_of(int(k), arrival, placed) for k, arrival, placed in rows]

    def save(self, path: FilePath, write: WriteTable = write_table) -> Path:
        """Write commands.csv, or another format with ``write``, and return the path.

        A target that failed has the reason in its line.
        """
        lines = self.lines()
        write(path, list(lines[0]), [list(line.values()) for line in lines])
        return Path(path)


def compensate(
    model: Model,
    targets: ArrayLike | Targets,
    predictor: Predictor | None = None,
    *,
    method: Method | str | None = None,
    frame: str | None = None,
    context: Context | None = None,
    history: SessionLike | None = None,
    run_up: bool = True,
    realisable: bool | Lattice = True,
    seed: ArrayLike | None = None,
    position_only: bool = False,
    locked: Sequence[int | str] = (),
    **settling: Any,
) -> Commands:
    """Compute joints that bring the real tip of an arm to targets.

    Args:
        model: arm and effects.
        targets: positions (N, 3) in m or poses (N, 4, 4), one of them, or `Targets` that were
            read from a file. Those with an orientation are poses.
        predictor: predictor of the residual of this model, from `train` or `load_predictor`.
        method: ``none``, ``deflection``, ``network`` or ``both``; by default all that was given.
        frame: frame of targets that do not state it: ``base``, the arm's own, or ``measured``, that
            of the rows with which the model was calibrated. Not needed if both are the same.
        context: circumstances at the targets; `Targets` have their own. Sides of arrival that it
            holds are used.
        history: session, or its file, after which the targets are executed in their order. Its
            last row gives the joints' positions and history. Without it these are unknown.
        run_up: whether joints may make a run-up, so that they arrive from a chosen side.
        realisable: whether commands are chosen among the joint values that the servos can hold,
            by the steps that the arm declares or by a lattice (docs/realisable.md). Switch it
            off for paths.
        seed: (n,) or (N, n) joints to start from, rad and m; default mid-range.
        position_only: leave the orientation free.
        locked: joints that stay at their seed, by name or number from 0.
        settling: options of the pseudo-target passes: ``single_pass``, ``tol_m``,
            ``max_passes``, ``max_correction_m``.

    Returns:
        One result per target. Invalid or unreachable targets are reported in `status`, not
        raised.

    Raises:
        InputError: shapes do not fit, an option is not allowed, the frame matters and is not
            stated, or the predictor belongs to another arm, model or method.
    """
    if predictor is not None:
        check_predictor(predictor, model, "compensate")
    chosen = method_of(method, predictor)
    numbers, placements, goals, told = place_targets(model, targets, context, frame or "")
    seeds = None
    if seed is not None:
        starts = np.asarray(seed, dtype=float)
        seeds = ik.checked_seed(model, starts, len(goals), "compensate")
    options = CompensationOptions(chosen, locked, run_up, realisable, **settling)
    unknown = History.unknown(model.arm.n)
    if history is None and not (
        any(map(np.any, told.approach)) or sided_joints(physics_of(model, chosen))
    ):
        still = np.zeros(model.arm.n)
        made: dict[int, Arrival] = {}
        kinds = [(goal.ndim, placed.frame) for goal, placed in zip(goals, placements, strict=True)]
        for kind in dict.fromkeys(kinds):  # positions or poses, of either frame
            ids = [k for k, other in enumerate(kinds) if other == kind]
            context = complete_after_move(told.take(np.array(ids)), unknown)
            outcomes = compensate_each(
                placements[ids[0]].promising(model),
                predictor,
                np.array([goals[k] for k in ids]),
                context=context,
                seed=None if seeds is None else seeds[ids],
                position_only=position_only,
                **vars(options),
            )
            for k, outcome, here in zip(ids, outcomes, context.each(len(ids)), strict=True):
                move = Move(outcome.command, None, still, still > 0)
                made[k] = Arrival(outcome, move, here, unknown)
        return Commands(numbers, tuple(made[k] for k in range(len(goals))), placements)
    at, came = (None, unknown) if history is None else find_last_rest(history, model)
    arrivals: list[Arrival] = []
    for k, (target, given) in enumerate(zip(goals, told.each(len(goals)), strict=True)):
        sides = np.sign(np.broadcast_to(given.approach or 0.0, model.arm.n)).astype(float)
        arrival = compensate_move(
            placements[k].promising(model),
            predictor,
            target,
            start=at,
            history=came,
            context_after=partial(complete_after_move, given),
            sides=sides if sides.any() else None,
            seed=None if seeds is None else seeds[k],
            position_only=position_only or target.ndim == 1,
            options=options,
        )
        arrivals.append(arrival)
        if history is not None and arrival.outcome.success:
            at, came = arrival.outcome.command, arrival.history
    return Commands(numbers, tuple(arrivals), placements)


def place_targets(
    model: Model, targets: ArrayLike | Targets, context: Context | None, frame: str
) -> tuple[np.ndarray, tuple[Placement, ...], list[np.ndarray], Context]:
    """Return targets in the frame of the model, with the circumstances that a command may use.

    Times of the targets are not used: a command comes after the model's session, whose clock has
    stopped (`Context.as_left`).

    Returns:
        Numbers (N,) and placements of the targets; the targets, each (3,) or (4, 4); and their
        common circumstances.

    Raises:
        InputError: a shape is wrong; circumstances are given twice, or the arm cannot have them;
            targets and call state different frames, or the frame is needed and not stated.
    """
    own: tuple[str, ...] = ()
    where = "targets"
    if isinstance(targets, Targets):
        if context is not None:
            raise InputError("compensate", "context", "given", "None: the targets have their own")
        numbers, told = targets.index, targets.context(model.arm.n)
        own, where = targets.frame, targets.source
        goals = [
            xyz if np.isnan(turn[0]) else quaternion.compute_pose(xyz, turn)
            for xyz, turn in zip(targets.xyz, targets.quaternion, strict=True)
        ]
    else:
        given = array_of("compensate", "targets", targets)
        given = given[None] if given.shape in ((3,), (4, 4)) else given
        if given.ndim not in (2, 3) or given.shape[1:] not in ((3,), (4, 4)) or not len(given):
            allowed = "positions (N, 3) or poses (N, 4, 4), N of at least 1"
            raise InputError("compensate", "targets", f"shape {given.shape}", allowed)
        numbers, told = np.arange(len(given)), context or Context()
        goals = list(given)
    for name, values in told.columns.items():
        check_circumstance(model.arm, name, values, where if context is None else "context")
    told = told.as_left(model.ended_s)
    other = next((said for said in own if said and frame and said != frame), "")
    if other:
        raise InputError(where, "frame", other, f"{frame}, as asked for, or none")
    keys = [
        (name or frame, str(here.labels.get("group", "")))
        for name, here in zip(own or ("",) * len(goals), told.each(len(goals)), strict=True)
    ]
    found = {key: find_placement(model, *key, where) for key in dict.fromkeys(keys)}
    placements = tuple(found[key] for key in keys)
    carried = [placed.carry_to_model(goal) for placed, goal in zip(placements, goals, strict=True)]
    return numbers, placements, carried, told


def complete_after_move(given: Context, arrived: History) -> Context:
    """Return the circumstances; history that they lack is taken from the joints after a move."""
    fields = {k: getattr(given, k) or v for k, v in arrived.fields().items()}
    return dataclasses.replace(given, **fields)


def find_last_rest(history: SessionLike, model: Model) -> tuple[np.ndarray, History]:
    """Return the joints (n,) at the end of a session, and their history."""
    session = history if isinstance(history, Session) else read_session(history, model.arm)
    session = with_fitted_run_ups(session, model)
    return session.q[-1], History(**{name: getattr(session, name)[-1] for name in PER_JOINT})


def method_of(given: Method | str | None, predictor: Predictor | None) -> Method:
    """Return a method by its name; without a name, the one that uses all that was given.

    Raises:
        InputError: there is no such method, or it needs a predictor, or another physics beside the
            network than the predictor was trained with.
    """
    usual = Method.DEFLECTION
    if predictor is not None:
        usual = Method.BOTH if predictor.provenance.beside_deflection else Method.NETWORK
    try:
        chosen = usual if given is None else Method(given)
    except ValueError:
        allowed = ", ".join(each.value for each in Method)
        raise InputError("compensate", "method", given, allowed) from None
    if chosen.uses_predictor and chosen is not usual:
        allowed = f"{usual.value}: because the predictor was trained so"
        if predictor is None:
            allowed = f"{usual.value}; or with --predictor, a predictor"
        raise InputError("compensate", "method", chosen.value, allowed)
    return chosen


def _line_of(index: int, arrival: Arrival, placed: Placement) -> dict[str, Any]:
    found, move = arrival.outcome, arrival.move
    ideal = found.ideal if found.realisable is None else found.realisable.ideal
    joints = joint_names(len(found.command))
    error = placed.turn_from_model(found.predicted_error)
    bound = float(np.max(found.sigma))
    sizes = (bound, found.expected_m, found.p90_m)
    sigma, expected, within = (1e3 * v if np.isfinite(bound) else None for v in sizes)

    def cells(
        what: str, names: Sequence[str], values: np.ndarray | None, known: bool
    ) -> dict[str, Any]:
        shown = values if known and values is not None else [None] * len(names)
        return {f"{what}{name}": value for name, value in zip(names, shown, strict=True)}

    return {
        "index": index,
        "status": str(found.status),
        "reason": found.reason,
        **cells("", joints, found.command, found.success),
        **cells("target_", XYZ, placed.carry_from_model(found.position), True),
        **cells("predicted_error_", XYZ, error, found.in_domain),
        "sigma_mm": sigma,
        "passes": found.passes,
        "expected_mm": expected,
        "p90_mm": within,
        "frame": placed.frame,
        **cells("approach_", joints, move.side, found.success),
        **cells("run_up_", joints, move.run_up, found.success),
        **cells("ideal_", joints, ideal, found.success),
    }
