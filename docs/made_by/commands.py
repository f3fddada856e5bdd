"""Pictures that commands make: the preview of a plan."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from longarm_comp.share import folder

_COLOURS = 96


def write_plan(to: Path) -> None:
    """What `longarm plan --picture` draws of 60 poses of the demonstration."""
    with tempfile.TemporaryDirectory() as place:
        drawn = Path(place) / "plan.png"
        words = ["plan", folder("config") / "arm_demo.yaml", "--kind", "sobol", "-n", 60, "--seen",
                 "--floor", -0.02, "-o", Path(place) / "poses.csv", "--picture", drawn]  # fmt: skip
        command = [sys.executable, "-m", "longarm_comp", *map(str, words)]
        subprocess.run(command, check=True, capture_output=True)
        save_small(drawn, to, 1100)


def save_small(drawn: Path, to: Path, width: int) -> None:
    """A picture of few colours as a small PNG of a width (px)."""
    image = Image.open(drawn).convert("RGB")
    image = image.resize(
        (width, round(width * image.height / image.width)), Image.Resampling.LANCZOS
    )
    few = image.quantize(_COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    few.save(to, optimize=True)
