"""Virtual environments for peers whose requirements conflict with ours.

They are created on demand in the user's cache folder and kept between runs.
"""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from collections.abc import Sequence
from pathlib import Path

from longarm_comp.core.errors import JobError


def python_of(name: str, requirements: Sequence[str]) -> Path:
    """The Python of a peer's environment, which is created on the first call.

    Raises:
        JobError: the peer cannot be installed (no network, or no version for this Python).
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "longarm_comp" / f"{name}-py{sys.version_info[0]}{sys.version_info[1]}"
    python = folder / "bin" / "python"
    ready = folder / "ready"
    if not ready.exists():
        venv.create(folder, with_pip=True, clear=True)
        command = [str(python), "-m", "pip", "install", "--quiet", *requirements]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise JobError(f"{name} cannot be installed: {done.stderr.strip()[-300:]}")
        ready.touch()
    return python
