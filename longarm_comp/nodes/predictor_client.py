"""The learned residual of another process: `predict_error` with the face of a core predictor."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node

from longarm_comp.core.arm import Arm
from longarm_comp.core.errors import JobError
from longarm_comp.nodes.interfaces import PREDICT_ERROR
from longarm_comp.nodes.messages import joints_message
from longarm_interfaces.srv import PredictError


class NoAnswer(JobError):  # noqa: N818
    """No predictor answered in time, or it has no file loaded."""


@dataclass(frozen=True)
class Answered:
    """Expected error at N postures, as `core.compensate.Prediction`."""

    error: np.ndarray
    sigma: np.ndarray
    in_domain: np.ndarray
    reason: list[str]


class PredictorClient:
    """Asks `predict_error` from a worker thread while the executor spins in its own.

    Args:
        timeout_s: no answer within it counts as no predictor.
    """

    def __init__(self, node: Node, arm: Arm, timeout_s: float) -> None:
        self._client = PREDICT_ERROR.client(node)
        self._arm = arm
        self._timeout_s = timeout_s
        self.file_hash = ""

    @property
    def present(self) -> bool:
        """Whether a predictor is on the graph."""
        return bool(self._client.service_is_ready())

    def predict(self, q: np.ndarray, context: Mapping[str, Any] | None = None) -> Answered:
        """Expected error at joints (N, n).

        Raises:
            NoAnswer: why.
        """
        rows = [self._one(row, _at(context or {}, i)) for i, row in enumerate(q)]
        error, sigma = np.zeros((len(rows), 3)), np.zeros((len(rows), 3))
        for i, row in enumerate(rows):
            error[i] = row.error.x, row.error.y, row.error.z
            sigma[i] = row.sigma
        inside = np.array([row.success and row.in_domain for row in rows])
        return Answered(error, sigma, inside, ["" if r.success else r.message for r in rows])

    def _one(self, q: np.ndarray, context: Mapping[str, Any]) -> PredictError.Response:
        sides = {float(side) for side in np.ravel(context.get("approach", 0.0))}
        request = PredictError.Request(
            joints=joints_message(self._arm, q),
            approach=int(sides.pop()) if len(sides) == 1 else 0,
            temperature_c=float(context.get("temperature_c", math.nan)),
            payload_kg=float(context.get("payload_kg", math.nan)),
        )
        if not self.present:
            raise NoAnswer("no error_predictor is running")
        done = threading.Event()
        future = self._client.call_async(request)
        future.add_done_callback(lambda _: done.set())
        if not done.wait(self._timeout_s):
            self._client.remove_pending_request(future)
            raise NoAnswer(f"error_predictor did not answer within {self._timeout_s:g} s")
        answer = future.result()
        if not answer.success and math.isnan(answer.sigma):
            raise NoAnswer(answer.message)
        self.file_hash = answer.message if answer.success else self.file_hash
        return answer


def _at(context: Mapping[str, Any], row: int) -> dict[str, Any]:
    """One row's context; what is one number for all stays so."""
    return {name: v[row] if np.ndim(v) else v for name, v in context.items()}
