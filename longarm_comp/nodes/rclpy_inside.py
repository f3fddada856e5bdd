"""What this package uses of rclpy beyond its documented interface; nothing else does.

Through rclpy's executor each message costs a wait set of all entities of the node, built in
Python, and a switch of threads. Together these take longer than computing a target.  So a worker
takes its messages, requests and responses itself, with the calls that the executor uses.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription

from longarm_comp.core.errors import JobError
from longarm_comp.nodes.image_inlet import SequenceWatch
from longarm_comp.nodes.interfaces import Service as ServiceName
from longarm_comp.nodes.interfaces import Topic
from longarm_comp.nodes.stamps import sent_s

CHECKED = "7.1"
"""Version of rclpy (Jazzy) that these calls were checked against, by the tests."""

_USED: dict[str, tuple[str, ...]] = {
    "WaitSet": (
        *("add_client", "add_guard_condition", "add_service", "add_subscription"),
        *("clear_entities", "wait"),
    ),
    "Subscription": ("take_message",),
    "Service": ("service_take_request", "service_send_response"),
    "Client": ("send_request", "take_response"),
}


def check_rclpy(implementation: Any = rclpy_implementation) -> None:
    """Raise `JobError` where this rclpy lacks a call that is needed."""
    for kind, names in _USED.items():
        for name in names:
            if not hasattr(getattr(implementation, kind, None), name):
                raise JobError(f"this rclpy has no {kind}.{name}; use rclpy {CHECKED} (Jazzy)")


class _Aside(CallbackGroup):
    """Callback group of entities that a worker takes; the executor ignores them."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing to do."""


class Inlets:
    """Topics, services and clients of one thread, and the wait set that it sleeps on."""

    def __init__(self, node: Node) -> None:
        check_rclpy()
        self._node, self._aside = node, _Aside()
        self._bell = GuardCondition(None, None, context=node.context)
        self._topics: list[tuple[Subscription, SequenceWatch, Callable[[Any, float], None]]] = []
        self._services: list[Service] = []
        self._set: Any = None

    # ------------------------------------------------------------------ what it takes

    def hear(self, topic: Topic, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic. Before `start`."""
        self._hear(topic, lambda message, _: callback(message), raw=False)

    def hear_raw(self, topic: Topic, callback: Callable[[bytes, float], None]) -> None:
        """The same; the callback gets bytes, and when they were sent (monotonic s)."""
        self._hear(topic, callback, raw=True)

    def _hear(self, topic: Topic, callback: Callable[[Any, float], None], *, raw: bool) -> None:
        made = topic.subscription(self._node, lambda message: None, self._aside, raw=raw)
        self._topics.append((made, SequenceWatch(), callback))

    def serve(self, service: ServiceName, callback: Callable[[Any, Any, float], None]) -> None:
        """Offer a service.

        The callback gets the request, a function that replies, and when the request was sent
        (monotonic s).
        """
        self._services.append(service.server(self._node, callback, self._aside))

    def caller(self, service: ServiceName) -> ServiceCaller:
        """A client of a service, for the same thread."""
        return ServiceCaller(service.client(self._node, self._aside), self._node)

    def start(self) -> None:
        """Build the wait set, when everything is declared."""
        with self._node.context.handle:
            self._set = rclpy_implementation.WaitSet(
                len(self._topics), 1, 0, 0, len(self._services), 0, self._node.context.handle
            )

    # ------------------------------------------------------------------ taking

    @property
    def lost(self) -> int:
        """Messages that were lost, by the numbers of those that came."""
        return sum(watch.lost for _, watch, _ in self._topics)

    def wake(self) -> None:
        """End a wait; from any thread."""
        self._bell.trigger()

    def wait(self, at_most_s: float | None = None) -> None:
        """Sleep until a message or a request arrives, or `wake`."""
        self._set.clear_entities()
        self._set.add_guard_condition(self._bell.handle)
        for topic, *_ in self._topics:
            self._set.add_subscription(topic.handle)
        for service in self._services:
            self._set.add_service(service.handle)
        self._set.wait(-1 if at_most_s is None else max(1, int(1e9 * at_most_s)))

    def empty(self, at_most: int) -> None:
        """Run the callbacks of everything received, so that no middleware queue overflows."""
        for service in self._services:
            for _ in range(at_most):
                with service.handle:
                    request, header = service.handle.service_take_request(service.srv_type.Request)
                if header is None:
                    break
                reply = partial(_send, service, header)
                service.callback(request, reply, sent_s(header.source_timestamp))
        for topic, watch, callback in self._topics:
            depth = max(at_most, topic.qos_profile.depth)
            numbers: list[int] = []
            for _ in range(depth):
                with topic.handle:
                    taken = topic.handle.take_message(topic.msg_type, topic.raw)
                if taken is None:
                    break
                numbers.append(taken[1]["publication_sequence_number"] or 0)
                callback(taken[0], sent_s(taken[1]["source_timestamp"]))
            watch.taken(numbers, full=len(numbers) >= topic.qos_profile.depth > 1)


def _send(service: Service, header: Any, response: Any) -> None:
    service.send_response(response, header)


class ServiceCaller:
    """A service client that waits in the calling thread, without an executor.

    rclpy offers this only for topics (`rclpy.wait_for_message`); this works the same way.
    """

    def __init__(self, client: Client, node: Node) -> None:
        self._client = client
        one_client = (0, 0, 0, 1, 0, 0)
        with node.context.handle:
            self._waiting = rclpy_implementation.WaitSet(*one_client, node.context.handle)

    @property
    def present(self) -> bool:
        return bool(self._client.service_is_ready())

    def send(self, request: Any) -> int:
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
