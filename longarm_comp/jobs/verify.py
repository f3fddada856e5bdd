"""Drives fresh targets over a running graph, without and with compensation."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.core.compensation.compensate import Method, Status
from longarm_comp.core.errors import JobError
from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.jobs.targets import Say, TargetRunner, Trial
from longarm_comp.workflows.verification import Verification, verification

Draw = Callable[[int], np.ndarray]
"""Draws so many further targets, (n, 3) m; fewer where there are no more."""

WITHOUT, COMPENSATED = "without compensation", "with compensation"


@dataclass(frozen=True, eq=False)
class _Chosen:
    """Targets that the graph accepts, and those that it refused.

    Attributes:
        xyz: (N, 3) m.
        refused: (target (3,) m, why) of each that was left out.
    """

    xyz: np.ndarray
    refused: tuple[tuple[np.ndarray, str], ...]


@dataclass(frozen=True, eq=False)
class _Verified:
    """What came of it: the targets, both runs, and the comparison."""

    chosen: _Chosen
    method: Method
    trials: tuple[Trial, Trial]
    result: Verification

    @property
    def statuses(self) -> Mapping[str, int]:
        """How often each status came with compensation, by its name."""
        return Counter(str(Status(int(s))) for s in self.trials[1].status)

    def report(self) -> dict[str, Any]:
        """Everything as plain data, for --json and the file."""
        without, compensated = self.trials
        return {
            "rows": self.result.rows,
            "helps": self.result.helps,
            "summary": self.result.summary,
            "gain_mm": 1e3 * self.result.gain_m,
            "gain_ci95_mm": [1e3 * g for g in self.result.gain_ci95_m],
            "method": self.method.value,
            "targets": len(self.chosen.xyz),
            "seen_in_both": len(self.result.without),
            "status": dict(self.statuses),
            "refused": [{"target": xyz, "why": why} for xyz, why in self.chosen.refused],
            "errors": [
                {"target": xyz, "without_mm": 1e3 * before, "compensated_mm": 1e3 * after}
                for xyz, before, after in zip(
                    self.chosen.xyz, without.off, compensated.off, strict=True
                )
            ],
        }


def choose(runner: TargetRunner, draw: Draw, n: int, methods: tuple[Method, ...]) -> _Chosen:
    """Up to n targets that the graph accepts with every method; nothing moves."""
    kept: list[np.ndarray] = []
    refused: list[tuple[np.ndarray, str]] = []
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
    return _Chosen(np.array(kept), tuple(refused))


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
    chosen: _Chosen,
    method: Method,
    *,
    seed: int = 0,
    progress: Say = lambda text, share: None,
) -> _Verified:
    """Drive the targets without compensation, then with a method, and compare."""
    without = runner.run(WITHOUT, chosen.xyz, Method.NONE, progress)
    compensated = runner.run(COMPENSATED, chosen.xyz, method, progress)
    result = verification((WITHOUT, COMPENSATED), without.off, compensated.off, seed)
    return _Verified(chosen, method, (without, compensated), result)
