"""A blocking service client: sends a request and waits for its response without an executor.

rclpy offers this only for topics (`rclpy.wait_for_message`); this works the same way.  Through an
executor, every response costs several wait sets built in Python, and the callbacks of its future
cost another one before the next request.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.client import Client
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation


class ServiceCaller:
    """A service client for one thread.

    Args:
        client: client of a node that is in no executor.
        context: context of that node.
    """

    def __init__(self, client: Client, context: Context) -> None:
        self._client = client
        one_client = (0, 0, 0, 1, 0, 0)
        with context.handle:
            self._waiting = rclpy_implementation.WaitSet(*one_client, context.handle)

    def send(self, request: Any) -> int:
        """Send a request and return its number."""
        handle = self._client.handle
        with handle:
            return int(handle.send_request(request))

    def answer(self, number: int, within_s: float) -> Any:
        """The response to a request, or None after ``within_s``. Earlier responses are dropped."""
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
