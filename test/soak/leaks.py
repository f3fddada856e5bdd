"""Detection of growing memory and open handles of processes, from Linux's /proc."""

import os
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

MEMORY_MB, HANDLES = 20.0, 8
"""More growth than this after the warm-up is a leak."""
_WARM_UP = 0.25  # share of a process's life that does not count
_FEWEST = 5


@dataclass
class Growth:
    """Samples of one process, with first and last level after the warm-up."""

    name: str
    samples: int
    memory_mb: tuple[float, float]
    handles: tuple[int, int]
    judged: bool
    """Sampled for so long that growth is not the warm-up any more."""

    @property
    def leaks(self) -> bool | None:
        """Whether it grew beyond what is allowed; None where that was not judged."""
        if not self.judged:
            return None
        more_mb = self.memory_mb[1] - self.memory_mb[0]
        return more_mb > MEMORY_MB or self.handles[1] - self.handles[0] > HANDLES


@dataclass
class LeakWatch:
    """Samples processes by name and id, since a restarted process has another id.

    Args:
        least: fewest samples of a process for its growth to be judged.
    """

    least: int = 300

    _seen: dict[tuple[str, int], list[tuple[float, int]]] = field(
        default_factory=lambda: defaultdict(list)
    )

    def sample(self, name: str, pid: int) -> None:
        """Sample one process. A process that is gone is ignored."""
        try:
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            handles = len(os.listdir(f"/proc/{pid}/fd"))
        except (OSError, IndexError):
            return
        self._seen[name, pid].append((pages * os.sysconf("SC_PAGE_SIZE") / 1e6, handles))

    def growth(self) -> list[Growth]:
        """Growth of each process with enough samples, over its longest life."""
        by_name: dict[str, Growth] = {}
        for (name, _), rows in self._seen.items():
            if len(rows) < _FEWEST or (name in by_name and by_name[name].samples > len(rows)):
                continue
            steady = np.array(rows[int(_WARM_UP * len(rows)) :])
            part = max(1, len(steady) // 5)
            first, last = np.median(steady[:part], axis=0), np.median(steady[-part:], axis=0)
            by_name[name] = Growth(
                name,
                len(rows),
                (float(first[0]), float(last[0])),
                (int(first[1]), int(last[1])),
                len(rows) >= self.least,
            )
        return list(by_name.values())
