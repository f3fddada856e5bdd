"""A node of a test's own that publishes again and again, in a thread."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from longarm_comp.jobs.graph_client import GraphClient


@contextmanager
def publishing(step: Callable[[GraphClient, int], None], pause_s: float = 0.02) -> Iterator[None]:
    """Call a function again and again, in a thread with a node of its own."""
    stop = threading.Event()

    def run() -> None:
        with GraphClient("", stop, "publisher") as client:
            number = 0
            while not stop.is_set():
                step(client, number)
                client.executor.spin_once(timeout_sec=pause_s)
                number += 1

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
