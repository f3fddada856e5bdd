"""The base class of all nodes, and the function that runs a node as a process."""

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from longarm_comp.core.effects import catalogue
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.nodes import EFFECTS, GUARD, NETWORK
from longarm_comp.nodes.clock import steady_timer
from longarm_comp.nodes.health import ERROR, OK, PERIOD, Health, Report, Tally
from longarm_comp.nodes.interfaces import Service
from longarm_comp.nodes.params import Param, declare
from longarm_comp.nodes.worker import Worker

WATCH = Param(
    "watch_period_s", 1.0, "time between two checks whether the file changed", 0.1, 3600.0
)
"""A parameter of every node that reads a file again when it changes."""

_LAST_WORDS_S = 2.0
"""Longest wait at a node's end for its subscribers to receive the last messages, s."""


class ArmNode(Node):
    """A node of an arm's graph, with the parameters of a table (and ``sections``: see `declare`).

    Attributes:
        p: values of the parameters, by name.
        tally: counts of events, such as refused messages.
        health: the reports in its ``parts`` are published on /diagnostics.
        abandoned: whether the node ends because its terminal or its supervisor is gone.
        exit_code: exit code of the process unless an error gives another one.
    """

    def __init__(
        self,
        executor: SingleThreadedExecutor,
        name: str,
        table: Sequence[Param],
        sections: Sequence[str] = (),
    ) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self.p = declare(self, table, sections)
        self.tally = Tally(self)
        self.health = Health(self, self.p[PERIOD.name])
        self._made_for = executor
        self._workers: list[Worker] = []
        self.abandoned, self.exit_code = False, 0

    def worker(self, capacity: int) -> Worker:
        """Make a worker thread that ends with the node; ``capacity`` jobs may wait for it."""
        self._workers.append(Worker(self, self._made_for, capacity, self.health.fault))

        self.health.parts["worker"] = self._report_workers
        return self._workers[-1]

    def _report_workers(self) -> Report:
        why = next((worker.failing for worker in self._workers if worker.failing), "")
        return Report(ERROR, f"no motion: {why}") if why else Report(OK, "every job was done")

    def close(self) -> bool:
        """Stop the node's threads; return whether all of them have ended. Must not raise."""
        ended = [worker.close() for worker in self._workers]
        return all(ended)

    def every(self, name: str, callback: Callable[[], Any]) -> None:
        """Call ``callback`` at the interval, s, of the parameter ``name``; never if it is 0."""
        if self.p[name]:
            steady_timer(self, self.p[name], callback)

    def on_change(self, files: Sequence[str], worker: Worker, job: Callable[[], Any]) -> None:
        """Give a job to a worker whenever one of the files is made, changed or removed."""

        def signature(file: str) -> tuple[int, int, int] | None:
            try:
                stat = os.stat(file)
            except OSError:
                return None
            return stat.st_ino, stat.st_size, stat.st_mtime_ns

        known = [signature(file) for file in files]

        def look() -> None:
            nonlocal known
            before, known = known, [signature(file) for file in files]
            if known != before:
                worker.submit(job)

        self.every(WATCH.name, look)

    def on_request(
        self, service: Service, worker: Worker, job: Callable[[Any], tuple[bool, str]]
    ) -> None:
        """Offer a service of std_srvs; a worker's ``job`` returns success and message."""

        async def serve(request: Any, response: Any) -> Any:
            future = worker.ask(partial(job, request))
            response.message = "too many jobs wait"
            if future is not None:
                response.success, response.message = await future
            return response

        service.server(self, serve, ReentrantCallbackGroup())


def run(make: Callable[[SingleThreadedExecutor], ArmNode], words: Sequence[str] = ()) -> int:
    """Run a node until a signal is received or its supervisor is gone; return the exit code.

    Signals only set an event, so a second signal does not interrupt the clean-up.

    Args:
        words: ``--effects FILE`` and ``--network FILE`` of the command line, as often as needed.
            No parameter may name such a file, because it is executed.
    """
    # Interval at which Python switches between threads, s. The default is 5 ms
    sys.setswitchinterval(2e-4)
    stop, gone = threading.Event(), threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())

    def hang_up(*_: object) -> None:
        gone.set()
        stop.set()

    signal.signal(signal.SIGHUP, hang_up)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor()
    node: ArmNode | None = None
    code = 0
    try:
        _execute_files(words)
        node = make(executor)
        executor.add_node(node)
        gc.freeze()  # everything loaded so far stays, so collections need not scan it again
        spin(executor, node, stop)
        node.abandoned = gone.is_set() or not stop.is_set()
    except LongarmError as error:
        print(error, file=sys.stderr)
        code = error.exit_code
    finally:
        ended = node is None or node.close()
        code = code or (0 if node is None else node.exit_code)
        executor.shutdown(timeout_sec=1.0)
        if not ended:
            # Python ends a thread inside the middleware by aborting the process
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
        if node is not None:
            # A message that no subscriber has yet is lost with its publisher
            by = time.monotonic() + _LAST_WORDS_S
            for publisher in node.publishers:
                left = Duration(seconds=max(0.0, by - time.monotonic()))
                if not publisher.wait_for_all_acked(left):
                    break
            node.destroy_node()
        rclpy.try_shutdown()
    return code


def _execute_files(words: Sequence[str]) -> None:
    if set(words[::2]) - {EFFECTS, NETWORK} or len(words) % 2:
        allowed = f"{EFFECTS} or {NETWORK} FILE, a Python file that is executed; then --ros-args"
        raise InputError("command line", "arguments", " ".join(words), allowed)
    for option, file in zip(words[::2], words[1::2], strict=True):
        if option == EFFECTS:
            catalogue.load_file(file)
        else:
            from longarm_comp.core.learn import others  # imports torch: only where it is needed

            others.load_file(file)


def spin(executor: SingleThreadedExecutor, node: ArmNode, stop: threading.Event) -> None:
    """Run callbacks until the event is set, or the node's supervisor (if any) is gone."""
    guard = os.environ.get(GUARD)
    while not stop.is_set() and guard in (None, str(os.getppid())):
        try:
            executor.spin_once(timeout_sec=0.2)
        except ExternalShutdownException:
            return
        except Exception as error:  # a message must not end a node
            node.health.fault(error)


def program(make: Callable[[SingleThreadedExecutor], ArmNode]) -> Callable[[], None]:
    """Return the main function of a node's module. ``make`` makes the node."""
    return lambda: sys.exit(run(make, remove_ros_args(sys.argv)[1:]))
