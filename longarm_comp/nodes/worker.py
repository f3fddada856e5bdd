"""Long work beside the executor: jobs one after another on a thread, in the order of arrival."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any

from rclpy.executors import Executor
from rclpy.task import Future

Job = Callable[[], Any]


class Worker:
    """One thread, one bounded queue.

    Args:
        executor: woken when an awaited job is done.
        capacity: jobs that may wait; more are refused.
        on_error: told what a job let through.
    """

    def __init__(
        self, executor: Executor, capacity: int, on_error: Callable[[Exception], None]
    ) -> None:
        self._executor = executor
        self._on_error = on_error
        self._jobs: queue.Queue[Job | None] = queue.Queue()
        self._capacity = capacity
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Jobs that wait."""
        return self._jobs.qsize()

    def submit(self, job: Job) -> bool:
        """Queue a job; False when too many wait already."""
        if self._jobs.qsize() >= self._capacity:
            return False
        self._jobs.put(job)
        return True

    def ask(self, job: Job, afterwards: Callable[[], None] = lambda: None) -> Future | None:
        """Queue a job whose result a coroutine can await; None when too many wait already.

        ``afterwards`` is done once the result is on its way.
        """
        future = Future(executor=self._executor)

        def answer() -> None:
            try:
                future.set_result(job())
            except Exception as error:
                future.set_exception(error)
            self._executor.wake()
            afterwards()

        return future if self.submit(answer) else None

    def close(self) -> None:
        """Finish the job at hand, drop the others."""
        while not self._jobs.empty():
            self._jobs.get_nowait()
        self._jobs.put(None)
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception as error:  # told, and the next job is taken
                self._on_error(error)
