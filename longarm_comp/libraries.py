"""Refuses libraries that are too old, in one line with the command that installs newer ones.

Ubuntu 24.04 packages pydantic 1.10 and OpenCV 4.6; rosdep installs these.
"""

from __future__ import annotations

import re
import sys
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

NEEDED = {
    "pydantic": ("pydantic>=2.6", "pydantic"),
    "OpenCV": ("opencv-python-headless>=4.10", "cv2"),
}
"""Of each library what pip installs, and the module that it brings."""


def refuse_old_libraries() -> None:
    """End the program with exit code 2 where a library that every program needs is too old."""
    old = [(name, found) for name in NEEDED if (found := _too_old(name))]
    if not old:
        return
    has = ", ".join(f"{name} {found}" for name, found in old)
    wanted = " ".join(f"'{NEEDED[name][0]}'" for name, _ in old)
    print(f"longarm_comp: too old: {has}; run: pip install {wanted}", file=sys.stderr)
    sys.exit(2)


def _too_old(name: str) -> str:
    """The version that is installed where it is too old; empty otherwise."""
    wanted, module = NEEDED[name]
    distribution, least = wanted.split(">=")
    try:
        found = version(distribution)
    except PackageNotFoundError:  # from another source, as of apt: ask the module
        try:
            found = str(import_module(module).__version__)
        except (ImportError, AttributeError):
            return ""  # missing: its import says so
    return found if _numbers(found) < _numbers(least) else ""


def _numbers(text: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", text)[:2]]
