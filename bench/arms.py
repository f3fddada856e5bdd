"""The arm of the benchmarks."""

from __future__ import annotations

from pathlib import Path

from longarm_comp.core.arm.arm import Arm
from longarm_comp.share import folder


def demo_arm_file() -> Path:
    """The arm of the demonstration, as it was installed or in the source tree.

    Raises:
        InputError: it is in neither place.
    """
    return folder("config") / "arm_demo.yaml"


def demo_arm() -> Arm:
    """The arm of the demonstration."""
    return Arm.load(demo_arm_file())
