"""What a loop does, where it puts its files, and how it names its runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from longarm_comp.core.errors import InputError
from longarm_comp.jobs.pace import Pace

LEAST_POSES = 60
"""With fewer poses the diagnosis cannot weigh a library of some 170 parameters."""


@dataclass(frozen=True)
class Names:
    """Names of the runs over the targets; ``{k}`` stands for the round."""

    without: str = "not compensated"
    before: str = "before"
    found: str = "round {k}: effects found"
    learned: str = "round {k}: effects found + network"


@dataclass(frozen=True)
class LoopSettings:
    """One loop.

    Attributes:
        poses: to measure in a round, from random sides. targets: fresh ones to judge by.
        network: train a predictor after every round.
        seed: of plans, targets, diagnosis and training.
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
        for name, least in (("rounds", 1), ("poses", LEAST_POSES), ("targets", 2)):
            if getattr(self, name) < least:
                raise InputError("loop", f"--{name}", getattr(self, name), f"at least {least}")

    def path(self, what: str, k: int) -> Path:
        """A file or folder of round k: ``session``, ``session_2``, ..."""
        name, dot, ending = what.partition(".")
        return self.out / (what if k == 1 else f"{name}_{k}{dot}{ending}")

    def facts(self) -> dict[str, Any]:
        """What must be the same where an interrupted loop goes on; ``rounds`` may grow."""
        return {k: v for k, v in asdict(self).items() if k not in ("out", "rounds")}
