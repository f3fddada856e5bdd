"""Refuses libraries that are too old or missing, in one line with the command that helps.

Ubuntu 24.04 packages pydantic 1.10 and OpenCV 4.6; rosdep installs these, and no llvmlite.
"""

import re
import sys
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

NEEDED = {
    "pydantic": ("pydantic>=2.10", "pydantic"),
    "OpenCV": ("opencv-python-headless>=4.10", "cv2"),
    "llvmlite": ("llvmlite>=0.43", "llvmlite"),
}
"""By library: the requirement for pip, and the module to import."""


def refuse_old_libraries() -> None:
    """End the program with exit code 2 where a library that every program needs is too old."""
    faults = {name: fault for name in NEEDED if (fault := _fault(name))}
    if not faults:
        return
    wanted = " ".join(f"'{NEEDED[name][0]}'" for name in faults)
    print(f"longarm_comp: {'; '.join(faults.values())}; run: pip install {wanted}", file=sys.stderr)
    sys.exit(2)


def _fault(name: str) -> str:
    """Return why a library cannot be used; empty if it can."""
    wanted, module = NEEDED[name]
    distribution, least = wanted.split(">=")
    try:
        found = version(distribution)
    except PackageNotFoundError:  # from another source, as of apt: ask the module
        try:
            found = str(import_module(module).__version__)
        except (ImportError, AttributeError) as error:  # missing, or made for another numpy
            return f"{name} cannot be used: {' '.join(str(error).split())}"
    return f"{name} {found} is too old" if _numbers(found) < _numbers(least) else ""


def _numbers(text: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", text)[:2]]
