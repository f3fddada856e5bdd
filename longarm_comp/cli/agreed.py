"""A question before the arm or its files change."""

from __future__ import annotations

import signal

import click

from longarm_comp.core.errors import JobError


def agreed(question: str, yes: bool) -> bool:
    """Whether the user says yes; asked on the terminal unless it was said with ``--yes``."""
    if yes:
        return True
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return click.confirm(question, err=True)
    except click.Abort:
        raise JobError("nobody said yes: answer the question, or give --yes") from None
    finally:
        signal.signal(signal.SIGINT, handler)
