"""A day of work from its bag: what was asked, where the tip came to rest, what the nodes said."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.bag import decoded, open_bag, read_bag

_ASKED, _SAID = "compensation", "diagnostics"


@dataclass(frozen=True, eq=False)
class _Served:
    """A target (3,), m, base frame, asked for at `t_s` since the bag began, and where the tip came
    to rest (3,), m; NaN where it was not seen.
    """

    t_s: float
    target: np.ndarray
    tip: np.ndarray

    @property
    def error_mm(self) -> float:
        """Distance of the tip from its target; NaN where it was not seen."""
        return 1e3 * float(np.linalg.norm(self.tip - self.target))


@dataclass(frozen=True)
class Notice:
    """What a part of a node said, from its first time to its last; numbers as they were at last."""

    first_s: float
    last_s: float
    part: str
    level: int
    message: str


@dataclass(frozen=True)
class Day:
    """A bag of work that lasts some hours.

    `refused`: how often, by reason; of reasons that differ in numbers alone the last. `said`:
    warnings, faults and what was learned, in the order of their beginning.
    """

    hours: float
    served: tuple[_Served, ...]
    refused: Counter[str] = field(default_factory=Counter)
    said: tuple[Notice, ...] = ()

    def by_hour(self) -> list[dict[str, Any]]:
        """A row an hour and one of the whole: targets, those seen, errors in mm."""
        hour = np.array([int(s.t_s // 3600) for s in self.served], dtype=int)
        error = np.array([s.error_mm for s in self.served])
        rows = [_row(f"{h}-{h + 1} h", error[hour == h]) for h in sorted(set(hour.tolist()))]
        return [*rows, _row("all", error)]


def _row(name: str, error: np.ndarray) -> dict[str, Any]:
    seen = error[np.isfinite(error)]
    figures: list[Any] = [None, None, None]
    if len(seen):
        figures = [float(seen.mean()), float(np.percentile(seen, 95)), float(seen.max())]
    made = {"hours": name, "targets": len(error), "seen": len(seen)}
    return made | dict(zip(("mean_mm", "p95_mm", "max_mm"), figures, strict=True))


def read_day(path: str | Path, arm: Arm, namespace: str | None, parts: tuple[str, ...]) -> Day:
    """Read a day from a bag that `longarm record` made.

    Args:
        namespace: of the arm, where the bag holds several.
        parts: of the diagnostics that are told whatever their level; others from a warning on.

    Raises:
        InputError: no bag, or it holds no `compensation` or no sighting.
    """
    session = read_bag(path, arm, namespace)
    told: dict[tuple[str, str], Notice] = {}
    asked: list[tuple[float, Any]] = []
    with open_bag(path) as reader:
        start = reader.start_time
        wanted = [
            c for c in reader.connections
            if c.topic.endswith(f"/{_SAID}") or _is_of(c.topic, _ASKED, namespace)
        ]  # fmt: skip
        raw = reader.messages(connections=wanted) if wanted else ()
        messages = ((c.topic, c.msgtype, stamp, data) for c, stamp, data in raw)
        for name, stamp, message in decoded(messages, arm, str(path)):
            t = (stamp - start) * 1e-9
            if name == _ASKED:
                asked.append((t, message))
                continue
            for status in message.status:
                _tell(told, t, status, parts)
        hours = reader.duration * 1e-9 / 3600.0
    if not asked:
        raise InputError(path, _ASKED, "no message", "a bag of `longarm record` while targets came")
    rows = list(zip(session.columns["t_s"].tolist(), session.q, session.xyz, strict=True))
    served: list[_Served] = []
    sent = [(t, m) for t, m in asked if m.accepted]
    for k, (t, message) in enumerate(sent):
        until = sent[k + 1][0] if k + 1 < len(sent) else math.inf
        q = np.array(message.executed.position)
        at = message.target.pose.position
        seen = (xyz for s, row, xyz in rows if t <= s < until and np.abs(row - q).max() < SAME_POSE)
        tip = next(seen, np.full(3, np.nan))
        served.append(_Served(t, np.array([at.x, at.y, at.z]), tip))
    reasons = {_without_numbers(m.message): m.message for _, m in asked if not m.accepted}
    refused = Counter(reasons[_without_numbers(m.message)] for _, m in asked if not m.accepted)
    said = tuple(sorted(told.values(), key=lambda s: s.first_s))
    return Day(hours, tuple(served), refused, said)


def _is_of(topic: str, name: str, namespace: str | None) -> bool:
    space, _, last = topic.rpartition("/")
    return last == name and (namespace is None or space.strip("/") == namespace.strip("/"))


def _tell(
    told: dict[tuple[str, str], Notice], t: float, status: Any, parts: tuple[str, ...]
) -> None:
    part = status.name.rpartition(": ")[2]
    level = int(status.level)
    if level == 0 and part not in parts:
        return
    key = status.name, _without_numbers(status.message)
    first = told[key].first_s if key in told else t
    told[key] = Notice(first, t, status.name, level, status.message)


def _without_numbers(text: str) -> str:
    return re.sub(r"[-+]?\d[\d.:e+-]*", "#", text)
