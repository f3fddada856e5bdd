"""Runs a node, or several, as a process.

SIGINT and SIGTERM end it cleanly; a failing callback does not end it.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Protocol

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from longarm_comp.core.errors import LongarmError
from longarm_comp.nodes.supervisor import GUARD


class _Runnable(Protocol):
    """A node that the runner can run."""

    def close(self) -> None:
        """Stop what the node started; must not raise."""

    def survived(self, error: Exception) -> None:
        """Report an exception that a callback raised."""


def run(make: Callable[[SingleThreadedExecutor], _Runnable | Sequence[_Runnable]]) -> int:
    """Spin a node, or several, until a signal.

    Signals only set an event, so a second one does not interrupt the clean-up.

    Returns:
        The exit code: 0, or 2 for bad parameters or files.
    """
    # Interval in which the threads of a node are switched, s. Python's default is 5 ms
    sys.setswitchinterval(2e-4)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor()
    nodes: Sequence[_Runnable] = ()
    try:
        made = make(executor)
        nodes = made if isinstance(made, Sequence) else (made,)
        for node in nodes:
            executor.add_node(node)
        gc.freeze()  # everything loaded so far stays, so collections need not scan it again
        spin(executor, nodes[-1], stop)
    except LongarmError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    finally:
        for node in reversed(nodes):
            node.close()
        executor.shutdown(timeout_sec=1.0)
        for node in reversed(nodes):
            node.destroy_node()  # type: ignore[attr-defined]
        rclpy.try_shutdown()
    return 0


def spin(executor: SingleThreadedExecutor, node: _Runnable, stop: threading.Event) -> None:
    """Serve callbacks until the event is set. Their exceptions are reported and not fatal.

    A node that a supervisor started ends when the supervisor is gone.
    """
    guard = os.environ.get(GUARD)
    while not stop.is_set() and guard in (None, str(os.getppid())):
        try:
            executor.spin_once(timeout_sec=0.2)
        except ExternalShutdownException:
            return
        except Exception as error:  # a message must not end a node
            node.survived(error)
