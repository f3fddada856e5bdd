"""The user's folder for what outlasts a process, by the XDG base directories."""

from __future__ import annotations

import os
from pathlib import Path

from longarm_comp.core.errors import InputError


def state_folder() -> Path:
    """Return this package's folder. Raises InputError where there is none."""
    given = os.environ.get("XDG_STATE_HOME", "")
    if os.path.isabs(given):
        return Path(given) / "longarm_comp"
    try:
        return Path.home() / ".local" / "state" / "longarm_comp"
    except RuntimeError as error:
        where = "a user with a home folder, or XDG_STATE_HOME"
        raise InputError("environment", "HOME", "missing", where) from error
