"""What a check of an arm's folder finds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

Level = Literal["missing", "implausible", "unmeasured", "measured", "declared"]
LEVELS = ("missing", "implausible", "unmeasured", "measured", "declared")


@dataclass(frozen=True)
class FolderFinding:
    """One thing about a folder.

    Attributes:
        level: missing and implausible must be put right; unmeasured is an assumption; measured
            is what a command measured and nobody changed since; declared is what arm.yaml says, for
            people to compare with the arm.
        where: file, and the key in it.
        text: what is the matter, and what to do.
    """

    level: Level
    where: str
    text: str

    @property
    def blocks(self) -> bool:
        """Whether the folder cannot be used as it is."""
        return self.level in ("missing", "implausible")


missing = partial(FolderFinding, "missing")
implausible = partial(FolderFinding, "implausible")
unmeasured = partial(FolderFinding, "unmeasured")
measured = partial(FolderFinding, "measured")
declared = partial(FolderFinding, "declared")
