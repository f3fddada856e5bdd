"""What goes into a compensation and what comes out of it: method, predictor, status, story."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Any, Protocol

import numpy as np


class Method(Enum):
    """What is compensated: rows of the paper's Table I."""

    NONE = "none"
    DEFLECTION = "deflection"
    NETWORK = "network"
    BOTH = "both"

    @property
    def physics(self) -> bool:
        """Whether the inverse kinematics knows the effects beyond geometry."""
        return self in (Method.DEFLECTION, Method.BOTH)

    @property
    def learned(self) -> bool:
        """Whether the predictor's expected error is taken off."""
        return self in (Method.NETWORK, Method.BOTH)


class Status(IntEnum):
    """Outcome; the numbers of `longarm_interfaces/srv/Compensate`."""

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

    @property
    def success(self) -> bool:
        """Whether the command is fit to be sent."""
        return self <= Status.OUT_OF_DOMAIN


class Prediction(Protocol):
    """Expected error at N postures."""

    @property
    def error(self) -> np.ndarray:
        """(N, 3), measured - predicted, m, base frame."""

    @property
    def sigma(self) -> np.ndarray:
        """(N, 3), m."""

    @property
    def in_domain(self) -> np.ndarray:
        """(N,) bool."""


class Predictor(Protocol):
    """The learned residual, as far as compensation knows it."""

    def predict(self, q: np.ndarray, context: Mapping[str, Any] | None = None) -> Prediction:
        """Expected error at joints (N, n); context: approach (N, n), temperature_c, ..."""


@dataclass(frozen=True)
class Compensation:
    """One target's story.

    Attributes:
        target: as asked: (3,) m or (4, 4).
        ideal: (n,) joints that the physics alone gives.
        predicted_error: (3,) m, expected at the command (at `ideal` in the single pass); zero
            where none is applied.
        sigma: (3,) m; NaN without a predictor.
        in_domain: the predictor answered for joints inside its training data.
        pseudo_target: ``target - predicted_error``, of the target's shape.
        command: (n,) joints to send; `ideal` where the status is no success.
        passes: pseudo-target passes used.
        status, reason: the outcome, and why in one sentence (empty on plain success).
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

    @property
    def success(self) -> bool:
        """Whether the command is fit to be sent."""
        return self.status.success


@dataclass(frozen=True)
class Compensations:
    """N targets: the fields of `Compensation` with a leading axis. Index it for one."""

    target: np.ndarray
    ideal: np.ndarray
    predicted_error: np.ndarray
    sigma: np.ndarray
    in_domain: np.ndarray
    pseudo_target: np.ndarray
    command: np.ndarray
    passes: np.ndarray
    status: np.ndarray
    reason: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.ideal)

    @property
    def success(self) -> np.ndarray:
        """(N,) bool: the command is fit to be sent."""
        made: np.ndarray = self.status <= Status.OUT_OF_DOMAIN
        return made

    def __getitem__(self, i: int) -> Compensation:
        return Compensation(
            self.target[i],
            self.ideal[i],
            self.predicted_error[i],
            self.sigma[i],
            bool(self.in_domain[i]),
            self.pseudo_target[i],
            self.command[i],
            int(self.passes[i]),
            Status(int(self.status[i])),
            self.reason[i],
        )
