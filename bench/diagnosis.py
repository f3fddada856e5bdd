"""Benchmarks of diagnosis: time and memory over samples and over candidates.

They cover all steps: geometry, search, structure, intervals, proof on a sealed hold-out
and next poses.  Two effects are hidden in the session, a compliant joint 2 and play in joint 4.
"""

from __future__ import annotations

import time
from functools import lru_cache
from typing import Any

from bench.arms import demo_arm
from bench.calibration import synthetic_session
from bench.comparison import Result, beside
from bench.subprocess_cost import Cost, cost_of
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.effects.catalogue import LIBRARY
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.identify.diagnose import diagnose

GOAL_S = 30.0
HIDDEN = (JointCompliance(2, 2e-3), Backlash(joint=4, width=6e-3))


def diagnose_once(samples: int, kinds: int = len(LIBRARY), seed: int = 0) -> dict[str, object]:
    """One diagnosis with the first ``kinds`` effects; generating the data is not timed."""
    session = synthetic_session(demo_arm(), samples, seed, hidden=HIDDEN)
    used = time.process_time()
    found = diagnose(demo_arm(), session, kinds=LIBRARY[:kinds], seed=seed)
    candidates = list_candidates(demo_arm(), session.context(), LIBRARY[:kinds]).testable
    return {
        "cpu_s": time.process_time() - used,
        "candidates": len(candidates),
        "verdict": found.verdict,
        "found": sorted({finding.name for finding in found.findings}),
    }


@lru_cache(maxsize=8)
def _cost(samples: int, kinds: int = len(LIBRARY), seed: int = 0) -> Cost:
    return cost_of(__name__, "diagnose_once", samples, kinds, seed)


def _facts(cost: Cost) -> dict[str, Any]:
    found = ", ".join(cost.result["found"]) or "nothing"
    return {
        "grown_mb": cost.grown_mb,
        "note": f"{cost.result['candidates']} candidates; {cost.result['verdict']}: {found}",
    }


def beside_goal(repeats: int = 3) -> Result:
    """The whole diagnosis of 300 samples, one core; goal 30 s."""
    costs = [_cost(300, len(LIBRARY), seed) for seed in range(repeats)]
    each = [cost.result["cpu_s"] for cost in costs]
    return beside("s CPU", each, "goal", [GOAL_S], **_facts(costs[0]))


def against_samples(samples: int) -> Result:
    """More samples."""
    return _grown(_cost(300), _cost(samples), samples / 300, "300")


def against_candidates(samples: int = 300) -> Result:
    """The whole library against its first half."""
    half, whole = _cost(samples, len(LIBRARY) // 2), _cost(samples)
    few, many = (cost.result["candidates"] for cost in (half, whole))
    return _grown(half, whole, many / few, f"{few} candidates")


def _grown(small: Cost, large: Cost, times: float, few: str) -> Result:
    used, expected = large.result["cpu_s"], small.result["cpu_s"] * times
    return beside("s CPU", [used], f"linear growth from {few}", [expected], **_facts(large))
