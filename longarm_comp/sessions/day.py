"""Reads a day of work from its bag: targets, errors at rest, refusals, messages of the nodes."""

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
from longarm_comp.sessions.bag import decode, in_namespace, open_bag, raw_messages, read_seen

_ASKED, _SAID = "compensation", "diagnostics"


@dataclass(frozen=True)
class Notice:
    """A diagnostic message. Messages that differ only in their numbers are one notice.

    Attributes:
        first_s, last_s: times of its first and last occurrence, s since the bag began.
        part: name of the diagnostic status, which ends in the part of the node.
        level: level of the last occurrence, as in DiagnosticStatus.
        message: text of the last occurrence.
    """

    first_s: float
    last_s: float
    part: str
    level: int
    message: str


@dataclass(frozen=True, eq=False)
class Day:
    """Summary of a bag of work that lasts some hours.

    Attributes:
        hours: duration of the bag.
        t_s: (N,) time at which each accepted target was requested, s since the bag began.
        error_mm: (N,) distance of the resting tip from each target; NaN if it was not measured.
        refused: number of refused targets by reason. Reasons that differ only in their numbers
            count as one, worded as the last of them.
        said: diagnostic messages of the nodes, by their first occurrence.
    """

    hours: float
    t_s: np.ndarray
    error_mm: np.ndarray
    refused: Counter[str] = field(default_factory=Counter)
    said: tuple[Notice, ...] = ()

    def by_hour(self) -> list[dict[str, Any]]:
        """Return one row for each hour with targets, and one for all hours.

        A row has the numbers of accepted targets and of those measured, and the errors in mm.
        """
        hour = (self.t_s // 3600).astype(int)
        parts = [(f"{h}-{h + 1} h", self.error_mm[hour == h]) for h in np.unique(hour)]
        rows = []
        for name, error in (*parts, ("all", self.error_mm)):
            seen = error[np.isfinite(error)]
            rows.append(
                {
                    "hours": name,
                    "targets": len(error),
                    "seen": len(seen),
                    "mean_mm": float(seen.mean()) if len(seen) else None,
                    "p95_mm": float(np.percentile(seen, 95)) if len(seen) else None,
                    "max_mm": float(seen.max()) if len(seen) else None,
                }
            )
        return rows


def read_day(path: str | Path, arm: Arm, namespace: str | None, parts: tuple[str, ...]) -> Day:
    """Read a day from a bag that `longarm record` made.

    Args:
        namespace: namespace of the arm, if the bag holds several arms.
        parts: parts of nodes whose diagnostics are kept at every level. Of all other parts, only
            warnings and errors are kept.

    Raises:
        InputError: there is no bag, it holds no `compensation` message or no sighting, or nobody
            knew where the tracker stands.
    """
    session, seen_in = read_seen(path, arm, namespace)
    told: dict[tuple[str, str], Notice] = {}
    asked: list[tuple[float, Any]] = []
    with open_bag(path) as reader:
        start = reader.start_time
        own = [c for c in reader.connections if in_namespace(c.topic, namespace)]
        wanted = [c for c in own if c.topic.endswith(f"/{_ASKED}")]
        spaces = {c.topic.rpartition("/")[0] for c in wanted}
        wanted += [c for c in reader.connections if c.topic.endswith(f"/{_SAID}")]
        for name, stamp, message in decode(raw_messages(reader, wanted), str(path)):
            t = (stamp - start) * 1e-9
            if name == _ASKED:
                asked.append((t, message))
                continue
            for status in message.status:
                level, (node, _, part) = int(status.level), status.name.partition(": ")
                if node.rpartition("/")[0] in spaces and (level or part in parts):
                    key = status.name, _without_numbers(status.message)
                    first = told[key].first_s if key in told else t
                    told[key] = Notice(first, t, status.name, level, status.message)
        hours = reader.duration * 1e-9 / 3600.0
    if not asked:
        raise InputError(path, _ASKED, "no message", "a bag of `longarm record` while targets came")
    if seen_in not in (bases := {message.header.frame_id for _, message in asked}):
        allowed = f"{', '.join(sorted(bases))}: a model that knows where the tracker stands"
        raise InputError(path, "tip_seen frame_id", seen_in, allowed)
    sent = [(t, m) for t, m in asked if m.accepted]
    t_s, at, error_mm = np.array([t for t, _ in sent]), session.columns["t_s"], []
    for k, (t, message) in enumerate(sent):
        until = t_s[k + 1] if k + 1 < len(sent) else math.inf
        off = np.abs(session.q - message.executed.position).max(axis=1)
        tips = session.xyz[(t <= at) & (at < until) & (off < SAME_POSE)]
        # In the base; `target` is in the frame in which it came
        pseudo, error = message.pseudo_target.pose.position, message.predicted_error
        target = np.array([pseudo.x + error.x, pseudo.y + error.y, pseudo.z + error.z])
        errors = np.linalg.norm(tips - target, axis=1)
        error_mm.append(1e3 * errors[0] if len(errors) else math.nan)
    reasons = {_without_numbers(m.message): m.message for _, m in asked if not m.accepted}
    refused = Counter(reasons[_without_numbers(m.message)] for _, m in asked if not m.accepted)
    said = tuple(sorted(told.values(), key=lambda s: s.first_s))
    return Day(hours, t_s, np.array(error_mm), refused, said)


def _without_numbers(text: str) -> str:
    return _NUMBER.sub(lambda found: found[1] or "#", text)


_NUMBER = re.compile(
    r"((?:joint|driver|servo|link|marker|sensor) \d+)|(?<!\w)[-+]?\d[\d.:e+-]*", re.IGNORECASE
)
"""A number; first those that are the name of something. A digit after a letter is of a name too."""
