"""Client of the `predict_error` service: the learned error computed by another process."""

from __future__ import annotations

import math
import time

import numpy as np
from rclpy.node import Node

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.result import Method
from longarm_comp.core.errors import JobError
from longarm_comp.core.learn.expansion import Expansion
from longarm_comp.nodes.interfaces import PREDICT_ERROR
from longarm_comp.nodes.messages import joints_message
from longarm_comp.nodes.service_caller import ServiceCaller
from longarm_interfaces.srv import PredictError


class NoAnswer(JobError):  # noqa: N818
    """No predictor answered in time, or it has no file loaded."""


_PROBE_S = 1.0
"""Pause between two probes of a silent predictor, s. A probe is sent without waiting."""


class PredictorClient:
    """Calls `predict_error` in the caller's thread.

    It has a hidden node of its own, which is in no executor.  A call then costs no thread switch
    and no round of the main executor.

    Args:
        node: node whose namespace and remappings apply.
        timeout_s: without an answer within this time there is no predictor.
    """

    def __init__(self, node: Node, arm: Arm, timeout_s: float) -> None:
        self._node = Node(
            f"_{node.get_name()}_asks", namespace=node.get_namespace(), context=node.context,
            use_global_arguments=False, enable_rosout=False, start_parameter_services=False,
        )  # fmt: skip
        self._client = self._node.create_client(
            PredictError, node.resolve_service_name(PREDICT_ERROR.name)
        )
        self._caller = ServiceCaller(self._client, node.context)
        self._arm = arm
        self._timeout_s = timeout_s
        self._open: int | None = None  # number of a request that is no longer waited for
        self._asked_s = 0.0
        self.file_hash = ""

    @property
    def present(self) -> bool:
        """Whether a predictor is on the graph."""
        return bool(self._client.service_is_ready())

    def ask(
        self,
        q: np.ndarray,
        context: Context,
        *,
        deflection: bool = True,
    ) -> Expansion:
        """Expected error at joints (n,) and its expansion around them, for one context.

        Args:
            deflection: whether the physics that it is added to includes link deflection.

        Raises:
            NoAnswer: no predictor runs, it has no file, or it does not answer in time.
        """
        request = PredictError.Request(
            joints=joints_message(self._arm, q),
            approach=np.array(context.approach, np.int8),
            temperature_c=float(context.column("temperature_c", math.nan)),
            payload_kg=float(context.column("payload_kg", math.nan)),
        )
        answer = self._call(request)
        if not answer.success and math.isnan(answer.sigma):
            raise NoAnswer(answer.message)
        if answer.success and answer.beside_deflection != deflection:
            fits = Method.learned_beside(deflection=answer.beside_deflection)
            raise NoAnswer(f"its predictor was trained for method {fits.value!r}")
        self.file_hash = answer.message if answer.success else self.file_hash
        n, e = self._arm.n, answer.error
        expanded = len(answer.jacobian) == 3 * n and len(answer.reach) == n
        return Expansion(
            error=np.array([e.x, e.y, e.z]),
            sigma=np.full(3, answer.sigma),
            in_domain=bool(answer.success and answer.in_domain),
            reason="" if answer.success else answer.message,
            jacobian=np.reshape(answer.jacobian, (3, n)) if expanded else np.zeros((3, n)),
            reach=np.array(answer.reach) if expanded else np.zeros(n),
        )

    def _call(self, request: PredictError.Request) -> PredictError.Response:
        if not self.present:
            raise NoAnswer("no error_predictor is running")
        if self._silent(request):
            raise NoAnswer("error_predictor does not answer, physics only until it does")
        question = self._send(request)
        answer = self._caller.answer(question, self._timeout_s)
        if answer is None:
            self._open = question
            raise NoAnswer(f"error_predictor did not answer within {self._timeout_s:g} s")
        return answer

    def _send(self, request: PredictError.Request) -> int:
        self._asked_s = time.monotonic()
        return self._caller.send(request)

    def _silent(self, request: PredictError.Request) -> bool:
        """Whether the last request is still unanswered.

        Only the first target waits for the timeout; later ones are compensated without the
        predictor until it answers a probe.
        """
        if self._open is None:
            return False
        if self._caller.answer(self._open, 0.0) is not None:
            self._open = None
            return False
        if time.monotonic() - self._asked_s >= _PROBE_S:
            self._open = self._send(request)
        return True

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
