"""A worker thread with a queue of jobs, which keeps long computations out of the executor.

The thread also takes the messages and requests of these jobs, from a wait set of its own.  Through
rclpy's executor each of them costs a wait set of all entities of the node, built in Python, and a
thread switch. Together these take longer than the job.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context
from rclpy.executors import Executor
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.task import Future

from longarm_comp.nodes.loss import SequenceWatch

Job = Callable[[], Any]


class ManualCallbackGroup(CallbackGroup):
    """Callback group of entities that a worker takes; the executor ignores them."""

    def can_execute(self, entity: Any) -> bool:
        """Never in an executor."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Never in an executor."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing to do."""


class Worker:
    """One thread with a bounded queue of jobs, worked off in the order of arrival.

    Args:
        node: node whose messages and requests it takes.
        executor: woken when an awaited job is done.
        capacity: number of jobs that may wait; further ones are refused.
        on_error: called with each exception of a job or callback.
    """

    def __init__(
        self, node: Node, executor: Executor, capacity: int, on_error: Callable[[Exception], None]
    ) -> None:
        self._context = node.context
        self._executor = executor
        self._on_error = on_error
        self._jobs: deque[Job] = deque()
        self._capacity = capacity
        self._bell = GuardCondition(None, None, context=node.context)
        self._closing = False
        self._thread: threading.Thread | None = None
        self._inlets: _Inlets | None = None

    @property
    def waiting(self) -> int:
        """Number of waiting jobs."""
        return len(self._jobs)

    @property
    def lost(self) -> int:
        """Messages that full queues have dropped."""
        return 0 if self._inlets is None else self._inlets.lost

    def start(self, topics: Sequence[Subscription] = (), services: Sequence[Service] = ()) -> None:
        """Start the thread, once.

        It takes the messages and requests of ``topics`` and ``services``, whose callback group
        must be a `ManualCallbackGroup`.

        The callbacks run on the thread, before the next job.  The callback of a service gets the
        request and a function that sends the response.
        """
        self._inlets = _Inlets(self._context, self._bell, topics, services)
        self._thread = threading.Thread(target=self._run, args=(self._inlets,), daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> bool:
        """Queue a job; False when too many wait already."""
        if self.waiting >= self._capacity:
            return False
        self._jobs.append(job)
        if threading.current_thread() is not self._thread:  # the worker itself need not be woken
            self._bell.trigger()
        return True

    def ask(self, job: Job) -> Future | None:
        """Queue a job whose result a coroutine can await; None when too many wait already."""
        future = Future(executor=self._executor)

        def answer() -> None:
            try:
                future.set_result(job())
            except Exception as error:
                future.set_exception(error)
            self._executor.wake()

        return future if self.submit(answer) else None

    def take(self, until: Callable[[], bool], within_s: float) -> bool:
        """Take messages and requests, inside a job, until a condition holds; whether it does."""
        end = time.monotonic() + within_s
        assert self._inlets is not None
        while not (done := until()) and not self._closing:
            left = end - time.monotonic()
            if left <= 0.0:
                break
            self._inlets.wait(max(1, int(1e9 * left)))
            self._inlets.empty(self._capacity)
        return done

    def close(self) -> None:
        """Finish the current job and drop the others."""
        self._closing = True
        self._bell.trigger()
        if self._thread is not None:
            self._thread.join(timeout=5.0)

    def _run(self, inlets: _Inlets) -> None:
        while not self._closing and self._context.ok():
            try:
                inlets.empty(self._capacity)
                if self._jobs:
                    self._jobs.popleft()()
                else:
                    inlets.wait()
            except Exception as error:  # reported; the worker goes on with the next job
                self._on_error(error)
                time.sleep(_PAUSE_S)


_PAUSE_S = 0.01
"""Pause after an exception, s, so that a repeating one does not use the whole processor."""


class _Inlets:
    """Topics and services that the worker takes, and the wait set that it sleeps on."""

    def __init__(
        self,
        context: Context,
        bell: GuardCondition,
        topics: Sequence[Subscription],
        services: Sequence[Service],
    ) -> None:
        self._bell, self._topics, self._services = bell, tuple(topics), tuple(services)
        self._watches = [SequenceWatch() for _ in self._topics]
        with context.handle:
            self._set = rclpy_implementation.WaitSet(
                len(self._topics), 1, 0, 0, len(self._services), 0, context.handle
            )

    @property
    def lost(self) -> int:
        """Messages that full queues have dropped."""
        return sum(watch.lost for watch in self._watches)

    def wait(self, at_most_ns: int = -1) -> None:
        """Sleep until a message, a request or a trigger of the guard condition arrives."""
        self._set.clear_entities()
        self._set.add_guard_condition(self._bell.handle)
        for topic in self._topics:
            self._set.add_subscription(topic.handle)
        for service in self._services:
            self._set.add_service(service.handle)
        self._set.wait(at_most_ns)

    def empty(self, at_most: int) -> None:
        """Run the callbacks of everything received, so that no middleware queue overflows."""
        for topic, watch in zip(self._topics, self._watches, strict=True):
            depth = max(at_most, topic.qos_profile.depth)
            numbers: list[int] = []
            for _ in range(depth):
                with topic.handle:
                    taken = topic.handle.take_message(topic.msg_type, topic.raw)
                if taken is None:
                    break
                numbers.append(taken[1]["publication_sequence_number"] or 0)
                topic.callback(taken[0])
            watch.taken(numbers, full=len(numbers) >= topic.qos_profile.depth > 1)
        for service in self._services:
            for _ in range(at_most):
                with service.handle:
                    request, header = service.handle.service_take_request(service.srv_type.Request)
                if header is None:
                    break
                service.callback(request, partial(_send, service, header))


def _send(service: Service, header: Any, response: Any) -> None:
    service.send_response(response, header)
