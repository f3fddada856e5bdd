"""A worker thread with a queue of jobs, which keeps long computations out of the executor.

The thread also takes the messages and requests of these jobs.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.task import Future

from longarm_comp.nodes.rclpy_inside import Inlets

Job = Callable[[], Any]


class Worker:
    """One thread with a bounded queue of jobs, worked off in the order of arrival.

    Args:
        executor: woken when an awaited job is done.
        capacity: number of jobs that may wait; further ones are refused.

    Attributes:
        idle: called while no job waits; does a piece of what can wait, and says whether it did.
        inlets: topics, services and clients whose callbacks run on the thread, before the next
            job. They are declared before `start`.
    """

    def __init__(
        self, node: Node, executor: Executor, capacity: int, on_error: Callable[[Exception], None]
    ) -> None:
        self._context = node.context
        self._executor = executor
        self._on_error = on_error
        self._jobs: deque[Job] = deque()
        self._capacity = capacity
        self._closing = False
        self._thread: threading.Thread | None = None
        self.idle: Callable[[], bool] = lambda: False
        self.inlets = Inlets(node)

    @property
    def waiting(self) -> int:
        return len(self._jobs)

    def start(self) -> None:
        """Start the thread, once."""
        self.inlets.start()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> bool:
        """Queue a job; False when too many wait already."""
        if self.waiting >= self._capacity:
            return False
        self._jobs.append(job)
        if threading.current_thread() is not self._thread:  # the worker itself need not be woken
            self.inlets.wake()
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
        """Take messages and requests, inside a job, until a condition holds; whether it does.

        Time in which this process was stopped does not count: what came meanwhile is still heard.
        """
        left = within_s
        while not self._closing:
            self.inlets.empty(self._capacity)
            if until():
                return True
            if left <= 0.0:
                return False
            begun = time.monotonic()
            self.inlets.wait(min(left, _WAIT_S))
            left -= min(time.monotonic() - begun, _WAIT_S)
        return until()

    def close(self) -> bool:
        """Finish the current job and drop the others; whether the thread has ended."""
        self._closing = True
        self.inlets.wake()
        if self._thread is None:
            return True
        self._thread.join(_LAST_JOB_S)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while not self._closing and self._context.ok():
            try:
                self.inlets.empty(self._capacity)
                if self._jobs:
                    self._jobs.popleft()()
                elif not self.idle():
                    self.inlets.wait()
            except Exception as error:  # reported; the worker goes on with the next job
                self._on_error(error)
                time.sleep(_PAUSE_S)


_LAST_JOB_S = 2.0
"""Time that the current job has when the node ends, s: a node has three in all."""
_WAIT_S = 0.05
"""The longest wait at once, s: a longer one is a process that was stopped."""
_PAUSE_S = 0.01
"""Pause after an exception, s, so that a repeating one does not use the whole processor."""
