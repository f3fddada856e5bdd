"""A service asked and waited for in one thread, without an executor.

rclpy has this for topics only (`rclpy.wait_for_message`), and this does it the same way.  Through
an executor every answer costs several rounds of building wait sets in Python, and a future's
callbacks another one before the next question.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.client import Client
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation


class Asking:
    """One thread's client.

    Args:
        client: of a node that is in no executor.
        context: of that node.
    """

    def __init__(self, client: Client, context: Context) -> None:
        self._client = client
        one_client = (0, 0, 0, 1, 0, 0)
        with context.handle:
            self._waiting = rclpy_implementation.WaitSet(*one_client, context.handle)

    def send(self, request: Any) -> int:
        """Ask; the question's number."""
        handle = self._client.handle
        with handle:
            return int(handle.send_request(request))

    def answer(self, number: int, within_s: float) -> Any:
        """What is answered to a question; None if nothing is in time. Earlier ones are dropped."""
        handle = self._client.handle
        end = time.monotonic() + within_s
        while True:
            with handle:
                header, response = handle.take_response(self._client.srv_type.Response)
                if header is not None and header.request_id.sequence_number == number:
                    return response
                left = end - time.monotonic()
                if header is None and left <= 0.0:
                    return None
                if header is None:
                    self._waiting.clear_entities()
                    self._waiting.add_client(handle)
                    self._waiting.wait(max(1, int(1e9 * left)))
