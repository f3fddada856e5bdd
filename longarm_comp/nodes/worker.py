"""A worker thread, which keeps long computations out of the executor.

For each message, rclpy's executor builds a wait set of all entities of the node in Python, and then
the thread is switched.  Together these take longer than computing a target.  So a worker itself
takes the messages, requests and responses for its jobs, with the calls that the executor uses.
These calls are not in rclpy's documented interface; nothing else in this package uses them.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.executors import Executor
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.waitable import NumberOfEntities, Waitable

from longarm_comp.core.errors import JobError
from longarm_comp.nodes.clock import sent_s
from longarm_comp.nodes.interfaces import Service as ServiceName
from longarm_comp.nodes.interfaces import Topic

CHECKED = "7.1"
"""Version of rclpy (Jazzy) with which the tests check these calls."""

_USED: dict[str, tuple[str, ...]] = {
    "WaitSet": (
        *("add_client", "add_guard_condition", "add_service", "add_subscription"),
        *("clear_entities", "is_ready", "wait"),
    ),
    "Subscription": ("take_message",),
    "Service": ("service_take_request", "service_send_response"),
    "Client": ("send_request", "take_response"),
}

Job = Callable[[], Any]
Hear = Callable[[Any, float | None], None]
"""Callback that gets a message, and when it was sent (sleepless s), if known."""

Reply = Callable[[Any], None]
"""Sends the response to a request."""

Serve = Callable[[Any, Reply, float | None], None]
"""Callback that gets a request, its reply, and when it was sent (sleepless s), if known."""

_LAST_JOB_S = 2.0
"""Time, s, that the current job has to finish when the node ends."""
_WAIT_S = 0.05
"""Longest single wait in `Worker.wait_until`, s. A wait that took longer shows that the process was
stopped."""
_PAUSE_S = 0.01
"""Pause after an exception, s, so that a repeating one does not use the whole processor."""
_FAILING_S = 60.0
"""Time for which a failed job counts in `Worker.failing` unless it succeeds later, s."""


def check_rclpy(implementation: Any = rclpy_implementation) -> None:
    """Raise `JobError` if this rclpy lacks a call that the worker needs."""
    for kind, names in _USED.items():
        for name in names:
            if not hasattr(getattr(implementation, kind, None), name):
                raise JobError(f"this rclpy has no {kind}.{name}; use rclpy {CHECKED} (Jazzy)")


class SequenceWatch:
    """Counts ``lost`` messages by gaps in the sequence numbers that publishers give them.

    A message has a number, but does not name its publisher. So each number is assigned to the
    publisher with the nearest lower last number. A gap counts as a loss only if the queue was full;
    otherwise it may come from a publisher that was received for the first time.
    """

    def __init__(self) -> None:
        self._last: list[int] = []
        self.lost = 0

    def count(self, numbers: list[int], *, full: bool) -> None:
        """Add the numbers of messages that were taken from the queue together, the oldest first.

        ``full``: whether the queue may have been full.
        """
        for number in numbers:
            before = max((last for last in self._last if last < number), default=None)
            if before is None:
                self._last.append(number)
                continue
            self._last[self._last.index(before)] = number
            if full:
                self.lost += number - before - 1


class _NotOfTheExecutor(CallbackGroup):
    """The callback group of entities whose messages a worker takes; the executor ignores them."""

    def can_execute(self, entity: Any) -> bool:
        return False

    beginning_execution = ending_execution = can_execute


def _take_requests(service: Service, most: int) -> Iterator[tuple[Any, Reply, int]]:
    """Yield up to ``most`` waiting requests of a service, as the last three fields of `Asked`."""
    for _ in range(most):
        with service.handle:
            request, header = service.handle.service_take_request(service.srv_type.Request)
        if header is None:
            return
        yield request, partial(service.send_response, header=header), int(header.source_timestamp)


@dataclass(frozen=True)
class Asked:
    """A request to one of the services of `Together`."""

    service: ServiceName
    request: Any
    reply: Reply
    sent_ns: int  # time of sending by the sender's clock, ns; 0: not known


class Together(Waitable):
    """Offers services whose waiting requests are handled together, in the executor's thread.

    The executor alone would take one request of each service in turn, in the order in which the
    services were made. ``serve`` gets all waiting requests, and must reply to each.
    """

    def __init__(
        self, node: Node, services: tuple[ServiceName, ...], serve: Callable[[list[Asked]], None]
    ) -> None:
        super().__init__(node.default_callback_group)
        group, self._serve = _NotOfTheExecutor(), serve
        self._made = {name: name.server(node, lambda *_: None, group) for name in services}
        self._places: list[int] = []
        node.add_waitable(self)

    def get_num_entities(self) -> NumberOfEntities:
        return NumberOfEntities(num_services=len(self._made))

    def add_to_wait_set(self, wait_set: Any) -> None:
        self._places = [wait_set.add_service(made.handle) for made in self._made.values()]

    def is_ready(self, wait_set: Any) -> bool:
        return any(wait_set.is_ready("service", place) for place in self._places)

    def take_data(self) -> list[Asked]:
        return [
            Asked(name, *taken)
            for name, made in self._made.items()
            for taken in _take_requests(made, made.qos_profile.depth)
        ]

    async def execute(self, taken_data: list[Asked]) -> None:
        self._serve(taken_data)


class Worker:
    """A thread with a bounded queue of jobs, which it does in the order of arrival.

    Before each job it runs the callbacks of received messages and requests. Their topics and
    services must be declared (`hear`, `serve`) before `start`.

    Args:
        executor: executor that is woken when an awaited job is done.
        capacity: number of jobs that may wait; further ones are refused.
        on_error: called with every exception of a job or a callback.
    """

    def __init__(
        self, node: Node, executor: Executor, capacity: int, on_error: Callable[[Exception], None]
    ) -> None:
        check_rclpy()
        self._node, self._executor, self._on_error = node, executor, on_error
        self._jobs: deque[Job] = deque()
        self._capacity = capacity
        self._closing = False
        self._thread: threading.Thread | None = None
        self._group = _NotOfTheExecutor()
        self._woken = GuardCondition(None, None, context=node.context)
        self._topics: list[tuple[Subscription, SequenceWatch, Hear]] = []
        self._services: list[Service] = []
        self._wait_set: Any = None
        self._failed: dict[str, tuple[str, float]] = {}

    def hear(self, topic: Topic, callback: Hear, depth: int | None = None) -> None:
        """Receive a topic; ``depth``: number of messages that may wait, if not the topic's."""
        made = topic.subscription(self._node, lambda message: None, self._group, depth=depth)
        self._topics.append((made, SequenceWatch(), callback))

    def serve(
        self, service: ServiceName, callback: Callable[[Any, Reply, float | None], None]
    ) -> None:
        """Offer a service; the callback gets request, reply function, time of sending."""
        self._services.append(service.server(self._node, callback, self._group))

    def caller(self, service: ServiceName) -> ServiceCaller:
        """Make a client of a service for use in the worker's thread."""
        return ServiceCaller(service.client(self._node, self._group), self._node)

    @property
    def lost_messages(self) -> int:
        """Number of lost messages of all topics, by gaps in the received sequence numbers."""
        return sum(watch.lost for _, watch, _ in self._topics)

    @property
    def failing(self) -> str:
        """A failure in the last minute of a job that has not succeeded since; empty if none."""
        recent = time.monotonic() - _FAILING_S
        return next((why for why, at_s in self._failed.values() if at_s > recent), "")

    @property
    def waiting(self) -> int:
        return len(self._jobs)

    def start(self, idle: Callable[[], bool] = lambda: False) -> None:
        """Start the thread. ``idle`` is called while no job waits; it returns whether it worked."""
        with self._node.context.handle:
            self._wait_set = rclpy_implementation.WaitSet(
                len(self._topics), 1, 0, 0, len(self._services), 0, self._node.context.handle
            )
        self._thread = threading.Thread(target=self._work_off_jobs, args=(idle,), daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> bool:
        """Queue a job; return False if too many jobs wait already."""
        if self.waiting >= self._capacity:
            return False
        self._jobs.append(job)
        if threading.current_thread() is not self._thread:  # the worker itself need not be woken
            self._woken.trigger()
        return True

    def submit_once(self, job: Job) -> None:
        """Queue a job unless the same job waits already, or too many jobs wait."""
        if job not in tuple(self._jobs):
            self.submit(job)

    def ask(self, job: Job) -> Future | None:
        """Queue a job; return a future of its result to await; None if too many jobs wait."""
        future = Future(executor=self._executor)

        def answer() -> None:
            try:
                future.set_result(job())
            except Exception as error:
                future.set_exception(error)
            self._executor.wake()

        return future if self.submit(answer) else None

    def wait_until(self, until: Callable[[], bool], within_s: float) -> bool:
        """Process messages inside a job until a condition holds; return whether it does in time.

        Time (s) in which this process was stopped does not count: its messages are processed.
        """
        left = within_s
        while not self._closing:
            self._take_all()
            if until():
                return True
            if left <= 0.0:
                return False
            begun = time.monotonic()
            self._wait_for_messages(min(left, _WAIT_S))
            left -= min(time.monotonic() - begun, _WAIT_S)
        return until()

    def close(self) -> bool:
        """Let the current job finish, drop the others, and return whether the thread has ended."""
        self._closing = True
        self._woken.trigger()
        if self._thread is None:
            return True
        self._thread.join(_LAST_JOB_S)
        return not self._thread.is_alive()

    def _wait_for_messages(self, at_most_s: float | None = None) -> None:
        """Sleep until a message or a request arrives, or `_woken` is triggered from any thread."""
        self._wait_set.clear_entities()
        self._wait_set.add_guard_condition(self._woken.handle)
        for topic, *_ in self._topics:
            self._wait_set.add_subscription(topic.handle)
        for service in self._services:
            self._wait_set.add_service(service.handle)
        self._wait_set.wait(-1 if at_most_s is None else max(1, int(1e9 * at_most_s)))

    def _work_off_jobs(self, idle: Callable[[], bool]) -> None:
        while not self._closing and self._node.context.ok():
            doing = "hearing messages"
            try:
                self._take_all()
                if self._jobs:
                    named: Any = (job := self._jobs.popleft())
                    while isinstance(named, partial):
                        named = named.func
                    doing = str(getattr(named, "__qualname__", named))  # one for all of its kind
                    job()
                    if doing in self._failed:  # replaced whole: other threads read it
                        self._failed = {k: v for k, v in self._failed.items() if k != doing}
                elif not idle():
                    self._wait_for_messages()
            except Exception as error:  # reported; the worker goes on with the next job
                why = f"{doing} failed: {type(error).__name__}: {error}"
                self._failed = {**self._failed, doing: (why, time.monotonic())}
                self._on_error(error)
                time.sleep(_PAUSE_S)

    def _take_all(self) -> None:
        """Run the callbacks of all received messages and requests, so that no queue overflows."""
        for service in self._services:
            for request, reply, sent_ns in _take_requests(service, self._capacity):
                service.callback(request, reply, sent_s(sent_ns))
        for topic, watch, callback in self._topics:
            depth = topic.qos_profile.depth
            numbers: list[int] = []
            for _ in range(max(self._capacity, depth)):
                with topic.handle:
                    taken = topic.handle.take_message(topic.msg_type, False)
                if taken is None:
                    break
                numbers.append(taken[1]["publication_sequence_number"] or 0)
                callback(taken[0], sent_s(taken[1]["source_timestamp"]))
            watch.count(numbers, full=len(numbers) >= depth > 1)


class ServiceCaller:
    """A service client that blocks its thread while it waits, without an executor."""

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
        """Wait for the response to the request ``number`` of `send`; None if it is late.

        Responses to earlier requests are dropped.
        """
        handle = self._client.handle
        end = time.monotonic() + within_s
        while True:
            with handle:
                header, response = handle.take_response(self._client.srv_type.Response)
                if header is not None:
                    if header.request_id.sequence_number == number:
                        return response
                elif (left := end - time.monotonic()) > 0.0:
                    self._waiting.clear_entities()
                    self._waiting.add_client(handle)
                    self._waiting.wait(max(1, int(1e9 * left)))
                else:
                    return None
