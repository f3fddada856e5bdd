"""The user's folder for files that outlast a process (XDG Base Directory Specification)."""

import os
from pathlib import Path

from longarm_comp.core.errors import InputError


def state_folder(own: str = "") -> Path:
    """Return an arm's own folder for state files; if it has none, this package's for the user.

    Raises:
        InputError: there is no home.
    """
    if own:
        return Path(own)
    given = os.environ.get("XDG_STATE_HOME", "")
    if os.path.isabs(given):
        return Path(given) / "longarm_comp"
    try:
        return Path.home() / ".local" / "state" / "longarm_comp"
    except RuntimeError as error:
        where = "a user with a home folder, or XDG_STATE_HOME"
        raise InputError("environment", "HOME", "missing", where) from error
