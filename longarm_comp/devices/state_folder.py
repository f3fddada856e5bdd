"""The user's folder for files that outlast a process (XDG Base Directory Specification)."""

from __future__ import annotations

import os
from pathlib import Path

from longarm_comp.core.errors import InputError


def state_folder() -> Path:
    """Return this package's folder for state files. Raises InputError if there is no home."""
    given = os.environ.get("XDG_STATE_HOME", "")
    if os.path.isabs(given):
        return Path(given) / "longarm_comp"
    try:
        return Path.home() / ".local" / "state" / "longarm_comp"
    except RuntimeError as error:
        where = "a user with a home folder, or XDG_STATE_HOME"
        raise InputError("environment", "HOME", "missing", where) from error
