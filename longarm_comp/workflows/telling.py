"""How far a long call is, where its caller only says ``progress=True``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

Telling = bool | Callable[..., None]
"""True: a line a step on standard error, which notebooks show; a function: called instead."""


def teller(progress: Telling) -> Callable[..., None]:
    """What is called with each step, and perhaps with the share that is done."""
    if callable(progress):
        return progress
    if not progress:
        return lambda *_: None
    begun, last = time.monotonic(), ""

    def tell(step: str, share: float | None = None) -> None:
        nonlocal last
        if step != last:
            done = "" if share is None else f"{100 * share:3.0f} % "
            sys.stderr.write(f"{time.monotonic() - begun:5.0f} s {done}{step}\n")
            sys.stderr.flush()
        last = step

    return tell
