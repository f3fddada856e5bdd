"""What a loop does, where it puts its files, and how it names its runs."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from longarm_comp.core.errors import InputError
from longarm_comp.jobs.client import Pace

NEAR_NOISE = 2.0
"""A mean error below so many times what the noise alone shows is as good as measured."""

RULE = (
    "another round follows if the last one brought the tip nearer by more than chance and the mean "
    f"error is still more than {NEAR_NOISE:g} times what the noise of the measurement alone shows"
)


def another_round(
    gain_ci95_m: tuple[float, float], mean_m: float, sigma_m: tuple[float, float, float]
) -> tuple[bool, str]:
    """The rule: whether to go on, and why.

    It has the 95 % interval of what the round took off the mean error at the tip, the mean after
    it, and the noise of a measurement along each axis, all in m.
    """
    rms = math.sqrt(sum(s * s for s in sigma_m) / 3.0)
    alone = math.sqrt(8.0 / math.pi) * rms  # mean length of a normal vector in three dimensions
    shown = f"the mean error is {1e3 * mean_m:.3f} mm, the noise alone shows {1e3 * alone:.3f} mm"
    if gain_ci95_m[0] <= 0.0:
        return False, f"this round did not bring the tip nearer by more than chance; {shown}"
    if mean_m <= NEAR_NOISE * alone:
        return False, f"the error that is left is near the noise: {shown}"
    return True, f"the error that is left is more than noise: {shown}"


@dataclass(frozen=True)
class Names:
    """Names of the runs over the targets; ``{k}`` stands for the round."""

    without: str = "not compensated"
    before: str = "before"
    found: str = "round {k}: effects found"
    learned: str = "round {k}: effects found + network"


@dataclass(frozen=True)
class LoopSettings:
    """One loop: poses to measure in a round, from random sides, and fresh targets to judge by.

    `network`: train a predictor after every round.
    """

    out: Path
    rounds: int = 3
    poses: int = 180
    targets: int = 40
    network: bool = True
    seed: int = 1
    pace: Pace = field(default_factory=Pace)
    names: Names = field(default_factory=Names)

    def __post_init__(self) -> None:
        # With fewer poses the diagnosis cannot weigh a library of some 170 parameters
        for name, least in (("rounds", 1), ("poses", 60), ("targets", 2)):
            if getattr(self, name) < least:
                raise InputError("loop", f"--{name}", getattr(self, name), f"at least {least}")

    def path(self, what: str, k: int) -> Path:
        """A file or folder of round k: ``session``, ``session_2``, ..."""
        name, dot, ending = what.partition(".")
        return self.out / (what if k == 1 else f"{name}_{k}{dot}{ending}")

    def facts(self) -> dict[str, Any]:
        """What must be the same where an interrupted loop goes on; ``rounds`` may grow."""
        return {k: v for k, v in asdict(self).items() if k not in ("out", "rounds")}
