"""Signals as events: SIGINT and SIGTERM end a job, Ctrl-Z pauses it and lets it go on."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set. The previous handlers are restored at the end."""
    stop = threading.Event()
    before = {
        number: signal.signal(number, lambda *_: stop.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def pause_on_stop_key() -> Iterator[threading.Event]:
    """An event that SIGTSTP (Ctrl-Z) sets and clears in turn, and SIGCONT clears.

    The process goes on hearing the graph meanwhile, which a stopped one would not.
    """
    pause = threading.Event()

    def turn(*_: object) -> None:
        (pause.clear if pause.is_set() else pause.set)()

    handlers = {signal.SIGTSTP: turn, signal.SIGCONT: lambda *_: pause.clear()}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield pause
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
