"""The input and output of a compensation: options, predictor, status, result."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Protocol

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.realisable import Lattice, Realisable
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.ik.solver import MAX_STARTS, Solution, position_of


class Method(Enum):
    """The errors that are compensated: rows of the paper's Table I."""

    NONE = "none"
    DEFLECTION = "deflection"
    NETWORK = "network"
    BOTH = "both"

    @property
    def uses_physics(self) -> bool:
        """True where the inverse kinematics uses the effects beyond geometry."""
        return self in (Method.DEFLECTION, Method.BOTH)

    @property
    def uses_predictor(self) -> bool:
        """True where the predictor's expected error is subtracted from the target."""
        return self in (Method.NETWORK, Method.BOTH)


class Status(IntEnum):
    """The outcome for a target; the numbers are those of `longarm_interfaces/srv/Compensate`."""

    SUCCESS = 0
    NO_PREDICTOR = 1
    OUT_OF_DOMAIN = 2
    UNREACHABLE = 3
    BAD_TARGET = 4
    BAD_FRAME = 5
    STALE_CONTEXT = 6
    NOT_READY = 7
    NOT_CONVERGED = 8
    CORRECTION_TOO_LARGE = 9
    INTERNAL_ERROR = 10
    STALE_TARGET = 11
    SUPERSEDED = 12
    NO_DRIVER = 13
    NOT_ACCEPTED = 14
    KEPT_OUT = 15

    def __str__(self) -> str:
        """Return its name as in files: ``success``, ``unreachable``, ..."""
        return self.name.lower()

    @property
    def success(self) -> bool:
        """True if the command may be sent, perhaps compensated by physics only."""
        return self <= Status.OUT_OF_DOMAIN


class PathRefused(JobError):  # noqa: N818
    """A path cannot be followed at way-point `row` (0-based); no part of it was sent."""

    def __init__(self, status: Status, row: int, why: str) -> None:
        super().__init__(f"way-point {row}: {status}: {why}")
        self.status, self.row = status, row


@dataclass(frozen=True)
class CompensationOptions:
    """The options of a compensation.

    Attributes:
        method: the errors that are compensated.
        locked: joints that stay at their seed, by name or 0-based number.
        run_up: whether a run-up may be added so that joints arrive from a chosen side.
        realisable: whether to choose the command among the joint values at which the servos can
            stand. True takes the steps that the arm declares, from each joint's zero; a `Lattice`
            gives others. Switch it off for paths of close targets. A single pass never chooses.
        starts: number of starts of the search for the target; with 1, from the seed alone, the
            joints do not jump along a path.
        single_pass: whether to correct only once, as in the paper.
        tol_m: change of the expected error, m, at or below which the passes end.
        max_passes: largest number of passes of the pseudo-target.
        max_correction_m: largest correction, physics and learned error together, m. None: see
            `permitted_correction`.
    """

    method: Method = Method.BOTH
    locked: Sequence[int | str] = ()
    run_up: bool = True
    realisable: bool | Lattice = True
    starts: int = MAX_STARTS
    single_pass: bool = False
    tol_m: float = 1e-5
    max_passes: int = 10
    max_correction_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("tol_m", "max_correction_m"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError("compensate", name, value, "a length above 0 m")
        if self.max_passes < 1:
            raise InputError("compensate", "max_passes", self.max_passes, "1 or more")

    def describe_unsettled(self) -> str:
        """Say why a target is given up after the last pass."""
        size = f"more than {1e3 * self.tol_m:g} mm after {self.max_passes} passes"
        return f"the expected error still changes by {size}"


@dataclass(frozen=True)
class Prediction:
    """The learned error (the expected residual) at N commands."""

    error: np.ndarray  # (N, 3) m, measured - predicted, base frame
    sigma: np.ndarray  # (N, 3) m, standard deviation of a measurement around ``error``
    in_domain: np.ndarray  # (N,) bool, whether the predictor may be believed
    reason: Sequence[str] = ()  # (N,) why not; empty where in domain
    doubt: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(N,) epistemic variance as a share of the largest that is accepted."""
    outside: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """(N,) bool: outside the training data, one of the reasons for not being in the domain."""


class ResidualPredictor(Protocol):
    """The interface of a predictor that compensation needs."""

    def predict(self, q: np.ndarray, context: Context | None = None) -> Prediction:
        """Return the learned error at joints (N, n), rad and m, in the given circumstances."""


@dataclass(frozen=True)
class Compensation:
    """The result for one target.

    Attributes:
        target: the given target: (3,) m or (4, 4).
        ideal: (n,) joints by the physics alone.
        predicted_error: (3,) m, learned error at the command (at `ideal` with `single_pass`); zero
            if none is applied.
        sigma: (3,) m, standard deviation of the tip's error at the command; NaN if not known.
        in_domain: whether the joints are inside the predictor's domain; False without a predictor.
        pseudo_target: ``target - predicted_error``, of the target's shape.
        command: (n,) joints to send; `ideal` if the status is no success.
        passes: number of passes of the pseudo-target.
        reason: why it is no success, or the doubts; empty if there are none.
        realisable: the choice of `command` among the servos' steps, from the joints
            ``realisable.ideal``. None if no choice was made.
        expected_m: expected distance of the tip from the target, m; NaN if not known.
        p90_m: distance that 90 of 100 such commands stay below, m; NaN if not known.
    """

    target: np.ndarray
    ideal: np.ndarray
    predicted_error: np.ndarray
    sigma: np.ndarray
    in_domain: bool
    pseudo_target: np.ndarray
    command: np.ndarray
    passes: int
    status: Status
    reason: str
    realisable: Realisable | None = None
    expected_m: float = math.nan
    p90_m: float = math.nan

    @property
    def success(self) -> bool:
        """True if the command may be sent, perhaps compensated by physics only."""
        return self.status.success

    @property
    def position(self) -> np.ndarray:
        """The position of the target, (3,) m."""
        return position_of(self.target)


def describe_outside(reason: str = "") -> str:
    """Say why the learned error is left out."""
    text = "outside the predictor's training data, compensated with physics only"
    return f"{text}: {reason}" if reason else text


_UNITS = (("centimetres", 1e2), ("millimetres", 1e3))


def guess_unit(position: np.ndarray, base: np.ndarray, reach_m: float) -> str:
    """Ask whether a target far beyond reach is in another unit; return "" if it is not so far.

    Args:
        position, base: (3,) m, of the target and of the arm's base.
        reach_m: reach of the arm, m.
    """
    away = math.dist(position, base)
    # No target is meant to be ten times the reach away, and no unit is so close to the metre
    if away <= 10.0 * reach_m:
        return ""
    named = next((name for name, size in _UNITS if away <= size * reach_m), "metres")
    return f"{away / reach_m:.3g} times the arm's reach away; are these {named}?"


def describe_miss(what: str, found: Solution) -> str:
    """Say by how much a search missed a target or pseudo-target, and why.

    Args:
        what: ``target`` or ``pseudo-target``.
    """
    # Only the linear deflection of an arm that is declared far too soft gets so large
    if not found.position_residual_m < 1e7:
        why = "the declared arm bends without limit (check loads, masses, stiffness)"
        return f"{what} missed: {why}"
    by = f"{1e3 * found.position_residual_m:.3g} mm, {np.degrees(found.angle_residual_rad):.3g} deg"
    return f"{what} missed by {by}: {found.reason.value}"


def pseudo_targets(targets: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return targets, (..., 3) or (..., 4, 4), less an error (..., 3), m: pseudo-targets."""
    pseudo = targets.copy()
    position_of(pseudo)[...] -= error
    return pseudo
