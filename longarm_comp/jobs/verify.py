"""Drives fresh targets over a running graph, without and with compensation."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.compensation.compensate import Method, Status
from longarm_comp.core.errors import JobError
from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.jobs.targets import Say, TargetRunner
from longarm_comp.workflows.verification import Verification, verification

Draw = Callable[[int], np.ndarray]
"""Draws so many further targets, (n, 3) m; fewer where there are no more."""
Refused = tuple[np.ndarray, str]
"""A target (3,), m, that the graph refuses, and why."""

WITHOUT, COMPENSATED = "without compensation", "with compensation"


def choose(
    runner: TargetRunner, draw: Draw, n: int, methods: tuple[Method, ...]
) -> tuple[np.ndarray, list[Refused]]:
    """Up to n targets (N, 3), m, that the graph accepts with every method, and those that it
    refused; nothing moves.
    """
    kept: list[np.ndarray] = []
    refused: list[Refused] = []
    # Random targets are drawn at most so many times as often as they are wanted
    while len(kept) < n and len(kept) + len(refused) < 4 * n:
        drawn = draw(n - len(kept))
        if not len(drawn):
            break
        for xyz, why in zip(drawn, runner.refusals(drawn, methods), strict=True):
            if why:
                refused.append((xyz, why))
            else:
                kept.append(xyz)
    if len(kept) < 2:
        why = f": {refused[0][1]}" if refused else ""
        raise JobError(f"fewer than two targets are reachable{why}", refused=len(refused))
    return np.array(kept), refused


def one_by_one(targets: np.ndarray) -> Draw:
    """Hands out (N, 3) targets of a file, m, in their order."""
    left = iter(targets)
    return lambda n: np.array(list(itertools.islice(left, n))).reshape(-1, 3)


def method_at_work(client: GraphClient) -> Method:
    """What the kinematics node compensates now; everything, where it compensates nothing."""
    (name,) = client.parameters("kinematics", "method")
    return Method.BOTH if Method(name) is Method.NONE else Method(name)


def verify(
    runner: TargetRunner,
    xyz: np.ndarray,
    refused: Sequence[Refused],
    method: Method,
    *,
    seed: int = 0,
    progress: Say = lambda text, share: None,
) -> tuple[Verification, dict[str, Any]]:
    """Drive targets (N, 3), m, without compensation, then with a method.

    Returns:
        The comparison, and everything as plain data, for --json and the file.
    """
    without = runner.run(WITHOUT, xyz, Method.NONE, progress)
    compensated = runner.run(COMPENSATED, xyz, method, progress)
    result = verification((WITHOUT, COMPENSATED), without.off, compensated.off, seed)
    errors = zip(xyz, without.off, compensated.off, strict=True)
    return result, {
        "rows": result.rows,
        "helps": result.helps,
        "summary": result.summary,
        "gain_mm": 1e3 * result.gain_m,
        "gain_ci95_mm": [1e3 * g for g in result.gain_ci95_m],
        "method": method.value,
        "targets": len(xyz),
        "seen_in_both": len(result.without),
        "status": dict(Counter(str(Status(int(s))) for s in compensated.status)),
        "refused": [{"target": target, "why": why} for target, why in refused],
        "errors": [
            {"target": target, "without_mm": 1e3 * before, "compensated_mm": 1e3 * after}
            for target, before, after in errors
        ],
    }
