"""The files of an arm's folder: changed by a test, and what `longarm check` finds in them."""

import re
from pathlib import Path

from longarm_comp.arm_folder.check import check_folder

NODES = ("servo_driver", "stereo_bridge", "simulated_arm")
"""Whose parameter files the folder holds."""


def levels(folder: Path, level: str) -> list[str]:
    """Where the findings of a level are."""
    return [f.where for f in check_folder(folder) if f.level == level]


def replaced(file: Path, old: str, new: str) -> None:
    """Replace the first place that fits a pattern; there is one."""
    text = file.read_text()
    assert re.search(old, text), f"{old} is not in {file.name}"
    file.write_text(re.sub(old, new, text, count=1))
