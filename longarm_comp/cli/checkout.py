"""Commands of a checkout: they run what is not installed with the package."""

from __future__ import annotations

import sys
from pathlib import Path

from longarm_comp.core.errors import JobError


def use(folder: str) -> None:
    """Make a folder of the checkout importable: from beside the package, else from here."""
    for root in (Path(__file__).resolve().parents[2], Path.cwd()):
        if (root / folder / "__init__.py").is_file():
            if str(root) not in sys.path:
                sys.path.append(str(root))
            return
    raise JobError(f"{folder} can only be run from a checkout of the project")
