"""Imports of libraries that only the studies need: the extra ``studies``."""

from collections.abc import Iterator
from contextlib import contextmanager

from longarm_comp.core.errors import JobError


@contextmanager
def extra() -> Iterator[None]:
    """Context manager for imports of libraries that only the studies need.

    Raises:
        JobError: one of them is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        wanted = "pip install 'longarm_comp[studies]'"
        library = str(error.name).partition(".")[0]
        raise JobError(f"this study needs {library}: {wanted}") from error
