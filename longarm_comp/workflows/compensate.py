"""Joint commands that bring the real tip to targets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.compensate import compensate_many
from longarm_comp.core.compensation.result import Compensation, Method, Status
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.targets import Command, Targets, write_commands
from longarm_comp.workflows.inputs import FilePath, check_predictor


@dataclass(frozen=True, eq=False, repr=False)
class Commands(Sequence[Compensation]):
    """One answer per target, in their order; index it for one.

    Attributes:
        numbers: (N,) number of each target.
        results: what came of each.
    """

    numbers: np.ndarray
    results: tuple[Compensation, ...]

    def __len__(self) -> int:
        return len(self.results)

    @overload
    def __getitem__(self, k: int) -> Compensation: ...
    @overload
    def __getitem__(self, k: slice) -> tuple[Compensation, ...]: ...
    def __getitem__(self, k: int | slice) -> Compensation | tuple[Compensation, ...]:
        return self.results[k]

    @property
    def command(self) -> np.ndarray:
        """(N, n) joints to send, rad and m; of no use where `success` is False."""
        return np.array([each.command for each in self.results])

    @property
    def status(self) -> tuple[Status, ...]:
        """How each target ended."""
        return tuple(each.status for each in self.results)

    @property
    def success(self) -> np.ndarray:
        """(N,) whether the command is fit to be sent."""
        return np.array([each.success for each in self.results])

    @property
    def predicted_error(self) -> np.ndarray:
        """(N, 3) learned error that was taken off, m."""
        return np.array([each.predicted_error for each in self.results])

    @property
    def summary(self) -> str:
        """How many targets ended how, in one line."""
        counts = Counter(status.name.lower() for status in self.status)
        return f"{len(self)} targets: " + ", ".join(f"{n} {name}" for name, n in counts.items())

    def __repr__(self) -> str:
        return f"Commands({self.summary})"

    def lines(self) -> list[Command]:
        """The lines of commands.csv."""
        return [_line(int(k), each) for k, each in zip(self.numbers, self, strict=True)]

    def save(self, path: FilePath) -> None:
        """Write commands.csv, with the reason where a target failed.

        Raises:
            InputError: the folder cannot be written.
        """
        write_commands(path, self.command.shape[1], self.lines())


def compensate(
    model: Model,
    targets: ArrayLike | Targets,
    predictor: Predictor | None = None,
    *,
    method: Method | str | None = None,
    context: Context | None = None,
    seed: ArrayLike | None = None,
    position_only: bool = False,
    locked: Sequence[int | str] = (),
    **settling: Any,
) -> Commands:
    """Joints that bring the real tip of an arm to targets.

    Args:
        model: arm and effects.
        targets: in the base frame: positions (N, 3) in m or poses (N, 4, 4), one of them, or
            `Targets` that were read from a file. Those with an orientation are poses.
        predictor: of what this model leaves, from `train` or `load_predictor`.
        method: ``none``, ``deflection``, ``network`` or ``both``; by default all that is given.
        context: circumstances in which the arm will stand; `Targets` have their own.
        seed: (n,) or (N, n) joints to start from, rad and m; default mid-range.
        position_only: leave the orientation free.
        locked: joints that stay at their seed, by name or number from 0.
        settling: when the pseudo-target passes end: ``single_pass``, ``tol_m``, ``max_passes``,
            ``max_correction_m``.

    Returns:
        One answer per target. Invalid or unreachable targets are reported in `status`, not
        raised.

    Raises:
        InputError: shapes do not fit, an option is not allowed, or the predictor belongs to
            another arm, model or method.
    """
    if predictor is not None:
        check_predictor(predictor, model, "compensate")
    chosen = fitting(predictor) if method is None else _method(method)
    if predictor is not None and chosen.learned and chosen is not fitting(predictor):
        allowed = f"{fitting(predictor).value}: as the predictor was trained"
        raise InputError("compensate", "method", chosen.value, allowed)
    numbers, batches = _batches(model, targets, context)
    starts = None if seed is None else _starts(seed, len(numbers))
    results: dict[int, Compensation] = {}
    for rows, goals, told in batches:
        found = compensate_many(
            model,
            predictor,
            goals,
            context=told,
            seed=starts[rows] if starts is not None and starts.ndim == 2 else starts,
            method=chosen,
            position_only=position_only,
            locked=tuple(locked),
            **settling,
        )
        results.update((int(row), found[k]) for k, row in enumerate(rows))
    return Commands(numbers, tuple(results[row] for row in range(len(numbers))))


def fitting(predictor: Predictor | None) -> Method:
    """The method that goes with a predictor: the physics that it was trained beside."""
    if predictor is None:
        return Method.DEFLECTION
    return Method.learned_beside(deflection=predictor.provenance.beside_deflection)


def _method(given: Method | str) -> Method:
    try:
        return Method(given)
    except ValueError:
        allowed = ", ".join(each.value for each in Method)
        raise InputError("compensate", "method", given, allowed) from None


def _starts(seed: ArrayLike, count: int) -> np.ndarray:
    given = np.asarray(seed, dtype=float)
    if given.ndim == 2 and len(given) != count:
        raise InputError("compensate", "seed", f"{len(given)} rows", f"one row or {count}")
    return given


_Batch = tuple[np.ndarray, np.ndarray, Context | None]


def _batches(
    model: Model, targets: ArrayLike | Targets, context: Context | None
) -> tuple[np.ndarray, list[_Batch]]:
    """Numbers of the targets; (rows, positions or poses, circumstances) to do together."""
    if not isinstance(targets, Targets):
        goals = np.asarray(targets, dtype=float)
        goals = goals[None] if goals.shape in ((3,), (4, 4)) else goals
        if goals.ndim not in (2, 3) or goals.shape[1:] not in ((3,), (4, 4)) or not len(goals):
            allowed = "positions (N, 3) or poses (N, 4, 4), N of at least 1"
            raise InputError("compensate", "targets", f"shape {goals.shape}", allowed)
        rows = np.arange(len(goals))
        return rows, [(rows, goals, context)]
    if context is not None:
        raise InputError("compensate", "context", "given", "None: the targets have their own")
    told = targets.context(model.arm.n)
    posed = ~np.isnan(targets.quaternion[:, 0])
    made: list[_Batch] = []
    for rows in (np.flatnonzero(posed), np.flatnonzero(~posed)):
        if not rows.size:
            continue
        goals = targets.xyz[rows]
        if posed[rows[0]]:
            goals = np.tile(np.eye(4), (len(rows), 1, 1))
            goals[:, :3, :3] = Rotation.from_quat(targets.quaternion[rows]).as_matrix()
            goals[:, :3, 3] = targets.xyz[rows]
        made.append((rows, goals, told.take(rows)))
    return targets.index, made


def _line(index: int, found: Compensation) -> Command:
    sigma = float(np.max(found.sigma))
    return Command(
        index=index,
        status=found.status.name.lower(),
        reason=found.reason,
        q=found.command if found.success else None,
        target=found.target if found.target.ndim == 1 else found.target[:3, 3],
        predicted_error=found.predicted_error if np.isfinite(sigma) else None,
        sigma_m=sigma if np.isfinite(sigma) else None,
        passes=found.passes,
    )
