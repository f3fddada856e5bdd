"""What a command on a running graph needs: a client, and signals that end its job."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@contextmanager
def handled(handlers: Mapping[int, Callable[..., Any]]) -> Iterator[None]:
    """Signals are handled so meanwhile; the previous handlers are restored at the end."""
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set."""
    stop = threading.Event()
    with handled(dict.fromkeys((signal.SIGINT, signal.SIGTERM), lambda *_: stop.set())):
        yield stop


@contextmanager
def on_graph(name: str, namespace: str, arm: Arm | None = None, **how: Any) -> Iterator[Any]:
    """A client on the running graph, of an arm where one is given, that signals stop."""
    from longarm_comp.jobs.client import ArmClient
    from longarm_comp.jobs.graph_client import GraphClient

    with (
        stop_on_signals() as stop,
        (
            GraphClient(namespace, stop, name)
            if arm is None
            else ArmClient(arm, namespace, stop, name, **how)
        ) as client,
    ):
        yield client
