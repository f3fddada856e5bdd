"""How a worker's thread gets its messages, requests and responses: directly, or by the executor."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.task import Future

from longarm_comp.nodes.interfaces import Service, Topic
from longarm_comp.nodes.loss import QueueWatch
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.rclpy_inside import DirectInlets, missing
from longarm_comp.nodes.stamps import sent_s

DIRECT = Param("direct", True, "the worker takes messages itself; false: rclpy's executor does")
"""A parameter of the nodes with a worker that hears or serves."""


class Caller(Protocol):
    """A service client of one thread."""

    @property
    def present(self) -> bool:
        """Whether the service is on the graph."""

    def send(self, request: Any) -> int:
        """Send a request and return its number."""

    def answer(self, number: int, within_s: float) -> Any:
        """The response to a request, or None after ``within_s``. Earlier responses are dropped."""


class Inlets(Protocol):
    """Topics, services and clients of one thread. Callbacks run in `empty`."""

    def hear(self, topic: Topic, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic. Before `start`."""

    def hear_raw(self, topic: Topic, callback: Callable[[bytes, float], None]) -> None:
        """The same; the callback gets bytes, and when they were sent (monotonic s)."""

    def serve(self, service: Service, callback: Callable[[Any, Any, float | None], None]) -> None:
        """Offer a service.

        The callback gets the request, a function that replies, and when the request was sent
        (monotonic s; None where this is not told).
        """

    def caller(self, service: Service) -> Caller:
        """A client of a service, for the same thread."""

    def start(self) -> None:
        """Called when everything is declared."""

    @property
    def lost(self) -> int:
        """Messages that were lost, at least."""

    @property
    def unfit(self) -> int:
        """Publishers that were not heard, as their QoS does not fit."""

    def wake(self) -> None:
        """End a wait; from any thread."""

    def wait(self, at_most_s: float | None = None) -> None:
        """Sleep until a message or a request arrives, or `wake`."""

    def empty(self, at_most: int) -> None:
        """Run the callbacks of everything received, requests first."""


def inlets(node: Node, *, direct: bool) -> Inlets:
    """The direct ones where they are asked for and this rclpy has the calls."""
    if direct and not (lacks := missing()):
        return DirectInlets(node)
    if direct:
        node.get_logger().warning(f"this rclpy lacks {', '.join(lacks)}: targets take longer")
    return PlainInlets(node)


class PlainInlets:
    """Through the node's executor, with rclpy's documented interface alone."""

    def __init__(self, node: Node) -> None:
        self._node, self._group = node, ReentrantCallbackGroup()
        self._got: deque[Callable[[], None]] = deque()
        self._bell = threading.Event()
        self._losses: list[tuple[_Told, QueueWatch]] = []
        self._unfit: list[_Told] = []

    @property
    def lost(self) -> int:
        """Messages that were lost, at least; as `DirectInlets.lost`."""
        return sum(max(told.count, watch.lost) for told, watch in self._losses)

    @property
    def unfit(self) -> int:
        """Publishers that were not heard, as their QoS does not fit."""
        return sum(told.count for told in self._unfit)

    def hear(self, topic: Topic, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic."""
        self._hear(topic, lambda message, _: callback(message), raw=False)

    def hear_raw(self, topic: Topic, callback: Callable[[bytes, float], None]) -> None:
        """The same; the callback gets bytes, and when they were sent (monotonic s)."""
        self._hear(topic, callback, raw=True)

    def _hear(self, topic: Topic, callback: Callable[[Any, float], None], *, raw: bool) -> None:
        lost, unfit, watch = _Told(), _Told(), QueueWatch(topic.depth)
        self._losses.append((lost, watch))
        self._unfit.append(unfit)

        def took(message: Any, info: Any) -> None:
            watch.took(info["publication_sequence_number"] or 0, info["received_timestamp"])
            self._enter(partial(callback, message, sent_s(info["source_timestamp"])))

        told = SubscriptionEventCallbacks(
            message_lost=lost, incompatible_qos=unfit, use_default_callbacks=False
        )
        topic.subscription(self._node, took, self._group, events=told, raw=raw)

    def serve(self, service: Service, callback: Callable[[Any, Any, float | None], None]) -> None:
        """Offer a service."""

        async def asked(request: Any, response: Any) -> Any:
            executor = self._node.executor
            future = Future(executor=executor)

            def reply(answer: Any) -> None:
                future.set_result(answer)
                executor.wake()

            self._enter(lambda: callback(request, reply, None))
            return await future

        service.server(self._node, asked, self._group)

    def caller(self, service: Service) -> Caller:
        """A client of a service."""
        return _PlainCaller(service.client(self._node, self._group))

    def start(self) -> None:
        """Nothing to build."""

    def wake(self) -> None:
        """End a wait."""
        self._bell.set()

    def wait(self, at_most_s: float | None = None) -> None:
        """Sleep until a message or a request arrives, or `wake`."""
        self._bell.wait(at_most_s)
        self._bell.clear()

    def empty(self, at_most: int) -> None:
        """Run the callbacks of everything received."""
        for _ in range(len(self._got)):
            self._got.popleft()()

    def _enter(self, job: Callable[[], None]) -> None:
        self._got.append(job)
        self._bell.set()


class _Told:
    """The last count that an event of the middleware told."""

    count = 0

    def __call__(self, event: Any) -> None:
        self.count = int(event.total_count)


class _PlainCaller:
    """Waits for what the executor receives."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._asked: dict[int, Future] = {}
        self._next = 0

    @property
    def present(self) -> bool:
        return bool(self._client.service_is_ready())

    def send(self, request: Any) -> int:
        for future in self._asked.values():
            self._client.remove_pending_request(future)
        self._next += 1
        self._asked = {self._next: self._client.call_async(request)}
        return self._next

    def answer(self, number: int, within_s: float) -> Any:
        future = self._asked.get(number)
        if future is None:
            return None
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        end = time.monotonic() + within_s
        while not future.done() and (left := end - time.monotonic()) > 0.0:
            done.wait(left)
        return future.result() if future.done() else None
