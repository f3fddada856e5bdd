"""Starts Python processes that look for no module in the folder where they are started.

Since Python 3.11, ``-P`` and ``PYTHONSAFEPATH`` ask for it.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_SAFE_PATH = sys.version_info >= (3, 11)
_RUN = "import sys; del sys.path[0]; import runpy; runpy.run_module({!r}, None, '__main__', True)"


def run_module(module: str) -> list[str]:
    """Return the command that runs a module, to which its arguments are appended."""
    if _SAFE_PATH:
        return [sys.executable, "-P", "-m", module]
    return [sys.executable, "-c", _RUN.format(module)]


@contextmanager
def starting_workers() -> Iterator[None]:
    """Have workers of `multiprocessing` that are started meanwhile import nothing from here.

    Before Python 3.11, this process is in the root folder meanwhile; workers are where it was.
    """
    if not _SAFE_PATH:
        here = os.getcwd()
        os.chdir(os.sep)
        try:
            yield
        finally:
            os.chdir(here)
        return
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    try:
        yield
    finally:
        if before is None:
            os.environ.pop("PYTHONSAFEPATH", None)
