"""Nearest points of a lattice: LLL reduction and Schnorr-Euchner enumeration.

It finds the integer vectors k in a box with the smallest ``|R k + y|``, R upper triangular, in
order.  Like the search for joints (`newton`) it is written once, without a branch on data, and
traced.  Machine code processes several targets in parallel if llvmlite is installed.  Plain Python
processes one after the other with the same results.

C. P. Schnorr and M. Euchner, Lattice basis reduction: improved practical algorithms and solving
subset sum problems, Mathematical Programming 66 (1994).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import floor, sqrt, where
from longarm_comp.core.ik.newton import Flow, Outcome, Repeat, State
from longarm_comp.core.ik.traced import Traced

_LOVASZ = 0.99
_MAX_SWEEPS = 200.0
_MAX_WIDER = 8.0
_SLACK = 1e-9  # of a step
NOTHING = 1e300
"""Squared distance of an entry without a point."""


@dataclass(frozen=True)
class Points:
    """The best points of N lattices, nearest first.

    Attributes:
        k: integers, (N, kept, n).
        distance2: ``|R k + y|^2``, (N, kept); `NOTHING` for entries without a point.
        nodes: number of visited nodes of the search tree, (N,).
    """

    k: np.ndarray
    distance2: np.ndarray
    nodes: np.ndarray


def nearest(
    R: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    *,
    kept: int = 16,
    max_nodes: int = 4000,
    compiled: bool | None = None,
) -> Points:
    """The `kept` points nearest to zero of each of N lattices.

    They are searched within the radius that holds twice as many on average (the ball's volume
    over that of a cell), and within a larger one if too few of them are in the box.

    Args:
        R: (N, n, n + 1): upper triangular without a zero on the diagonal, and y beside it.
        low, high: (N, n), integers, the box of k.
        kept: number of points.
        max_nodes: number of nodes after which a search ends with the points found so far.
        compiled: machine code or plain Python; by default as in `Traced.run`.
    """
    count, n = low.shape
    traced = _search(n, kept)
    given = {
        "R": R.reshape(count, n * (n + 1)), "low": low, "high": high, "live": np.ones((count, 1)),
        "radius2": _radius2(R, 2.0 * kept), "cap": np.full((count, 1), float(max_nodes)),
    }  # fmt: skip
    answer = traced.run(given, count, compiled)
    points, distance2, nodes = (answer[:, traced.slice(a)] for a in ("k", "distance2", "nodes"))
    return Points(points.reshape(count, kept, n), distance2, nodes[:, 0])


def _radius2(R: np.ndarray, points: float) -> np.ndarray:
    """Squared radius of the ball that holds a number of points on average, (N, 1)."""
    n = R.shape[1]
    ball = math.pi ** (n / 2) / math.gamma(n / 2 + 1)
    log_cell = np.log(np.abs(np.diagonal(R, axis1=1, axis2=2))).sum(axis=1)
    radius2: np.ndarray = np.exp((math.log(points / ball) + log_cell) * (2.0 / n))[:, None]
    return radius2


# ------------------------------------------------------------------ what is traced


def rows(n: int, kept: int) -> dict[str, range]:
    """Layout of a search's state: inputs, results, work.

    `open<l>` keeps the loop over level l of the tree running; the tree's root is level n.
    """
    sizes = {
        "R": n * (n + 1), "low": n, "high": n, "radius2": 1, "live": 1, "cap": 1,
        "k": kept * n, "distance2": kept, "nodes": 1,
        "U": n * n, "more": 1, "sweeps": 1, "wider": 1, "inner2": 1,
        "W": n * n, "spread2": n * n, "expected": n * (n + 1),
        "z": n, "centre": n, "side": n, "sum": n + 1,
        **{f"open{level}": 1 for level in range(n + 1)},
    }  # fmt: skip
    layout, at = {}, 0
    for name, size in sizes.items():
        layout[name] = range(at, at + size)
        at += size
    return layout


def begin(s: State, n: int, kept: int) -> Outcome:
    """Initial state."""
    return {
        "U": [float(i == j) for i in range(n) for j in range(n)], "sweeps": [0.0],
        "more": s["live"], "wider": [0.0], "inner2": [0.0],
        "k": [0.0] * (kept * n), "distance2": [NOTHING] * kept, "nodes": [0.0],
        "sum": [0.0] * (n + 1), f"open{n}": s["live"],
    }  # fmt: skip


def sweep(s: State, n: int) -> Outcome:
    """A pass of the LLL reduction over neighbouring columns; `more`: some were swapped.

    U collects the operations on the columns of R, an integer matrix of determinant +-1. Rotations
    keep R triangular.
    """
    R, U, wide = list(s["R"]), list(s["U"]), n + 1
    swaps: Any = 0.0
    for b in range(1, n):
        a = b - 1
        _subtract(R, U, n, b, a)
        corner, beside, own = R[a * wide + a], R[a * wide + b], R[b * wide + b]
        swap = beside * beside + own * own < _LOVASZ * corner * corner
        swaps = swaps + swap
        for matrix, width, height in ((R, wide, b + 1), (U, n, n)):
            for i in range(height):
                left, right = matrix[i * width + a], matrix[i * width + b]
                matrix[i * width + a] = where(swap, right, left)
                matrix[i * width + b] = where(swap, left, right)
        p, q = R[a * wide + a], R[b * wide + a]
        size = sqrt(p * p + q * q)
        cosine, sine = p / size, q / size
        for j in range(a, wide):
            up, down = R[a * wide + j], R[b * wide + j]
            R[a * wide + j] = cosine * up + sine * down
            R[b * wide + j] = cosine * down - sine * up
        R[b * wide + a] = 0.0
    sweeps = s["sweeps"][0] + 1.0
    more = where(swaps > 0.0, where(sweeps < _MAX_SWEEPS, 1.0, 0.0), 0.0)
    return {"R": R, "U": U, "sweeps": [sweeps], "more": [more]}


def reduce(s: State, n: int) -> Outcome:
    """Size-reduce all columns, once neighbours are in order."""
    R, U = list(s["R"]), list(s["U"])
    for b in range(1, n):
        for a in range(b - 1, -1, -1):
            _subtract(R, U, n, b, a)
    return {"R": R, "U": U}


def inverse(s: State, n: int) -> Outcome:
    """k as a function of the residual, ``k = expected + W (R z + y)``, so that the box prunes.

    `spread2` sums squares of W up to a level; `expected` is kept level by level.
    """
    wide, R = n + 1, s["R"]
    W: list[Any] = list(s["U"])
    for j in range(n):
        for i in range(n):
            for a in range(j):
                W[i * n + j] = W[i * n + j] - W[i * n + a] * R[a * wide + j]
            W[i * n + j] = W[i * n + j] / R[j * wide + j]
    expected, spread2 = list(s["expected"]), list(s["spread2"])
    for i in range(n):
        middle: Any = 0.0
        square: Any = 0.0
        for j in range(n):
            middle = middle - W[i * n + j] * R[j * wide + n]
            square = square + W[i * n + j] * W[i * n + j]
            spread2[i * n + j] = square
        expected[n * n + i] = middle
    return {"W": W, "spread2": spread2, "expected": expected}


def _subtract(R: list[Any], U: list[Any], n: int, b: int, a: int) -> None:
    """Subtract the multiple of column a from column b that makes it shortest."""
    wide = n + 1
    times = floor(R[a * wide + b] / R[a * wide + a] + 0.5)
    for i in range(a + 1):
        R[i * wide + b] = R[i * wide + b] - times * R[i * wide + a]
    for i in range(n):
        U[i * n + b] = U[i * n + b] - times * U[i * n + a]


def enter(s: State, n: int, level: int) -> Outcome:
    """The first integer to try at a level: the nearest to the centre given by the levels above.

    The level is skipped if the box cannot be reached within the radius.
    """
    wide, R, above = n + 1, s["R"], level + 1
    may: Any = s[f"open{above}"][0]
    expected = list(s["expected"])
    room2 = s["radius2"][0] - s["sum"][above]
    for i in range(n):
        k = expected[(above + (above < n)) * n + i]
        if above < n:
            left = R[above * wide + above] * (s["z"][above] - s["centre"][above])
            k = expected[above * n + i] = k + s["W"][i * n + above] * left
        reach2 = _SLACK + (1.0 + _SLACK) * room2 * s["spread2"][i * n + level]
        for gap in (s["low"][i] - k, k - s["high"][i]):
            may = where(gap > 0.0, where(gap * gap > reach2, 0.0, may), may)
    rest: Any = -R[level * wide + n]
    for j in range(above, n):
        rest = rest - R[level * wide + j] * s["z"][j]
    centre = rest / R[level * wide + level]
    z = floor(centre + 0.5)
    side = where(centre < z, -1.0, 1.0)
    tried = _tried(s, n, level, z, side, centre, may)
    return tried | {"centre": _with(s["centre"], level, centre), "expected": expected}


def advance(s: State, n: int, level: int) -> Outcome:
    """The next integer at a level, alternating to both sides with growing distance."""
    by = s["side"][level]
    side = where(by > 0.0, -1.0 - by, 1.0 - by)
    z, centre = s["z"][level] + by, s["centre"][level]
    return _tried(s, n, level, z, side, centre, s[f"open{level}"][0])


def _tried(
    s: State, n: int, level: int, z: Any, side: Any, centre: Any, may: Any
) -> dict[str, Any]:
    miss = s["R"][level * (n + 1) + level] * (z - centre)
    total = s["sum"][level + 1] + miss * miss
    nodes = s["nodes"][0]
    going = where(total < s["radius2"][0], where(nodes < s["cap"][0], may, 0.0), 0.0)
    return {
        "z": _with(s["z"], level, z), "side": _with(s["side"], level, side),
        "sum": _with(s["sum"], level, total), f"open{level}": [going], "nodes": [nodes + going],
    }  # fmt: skip


def leaf(s: State, n: int, kept: int) -> Outcome:
    """Insert a point in the box into the list of the best. The worst sets the radius."""
    found: Any = where(s["open0"][0] > 0.0, s["sum"][0], NOTHING)
    found = where(found < s["inner2"][0], NOTHING, found)
    point = []
    for i in range(n):
        k: Any = 0.0
        for j in range(n):
            k = k + s["U"][i * n + j] * s["z"][j]
        found = where(s["low"][i] <= k, where(k <= s["high"][i], found, NOTHING), NOTHING)
        point.append(k)
    entry = [found, *point]
    held = [[s["distance2"][i], *s["k"][i * n : (i + 1) * n]] for i in range(kept)]
    entries, above = [], entry
    for own in held:  # entries farther than the new one move down by one
        entries.append([where(found < own[0], a, b) for a, b in zip(above, own, strict=True)])
        above = [where(found < own[0], a, b) for a, b in zip(own, entry, strict=True)]
    distance2, points = [e[0] for e in entries], [k for e in entries for k in e[1:]]
    radius2 = where(distance2[-1] < s["radius2"][0], distance2[-1], s["radius2"][0])
    return {"distance2": distance2, "k": points, "radius2": [radius2]}


def widen(s: State, n: int) -> Outcome:
    """Search again with twice the squared radius if the list is not full; `open<n>`: repeat.

    Points inside the radius before are already in the list.
    """
    lacking = where(s["distance2"][-1] < NOTHING, 0.0, s[f"open{n}"][0])
    wider = s["wider"][0] + lacking
    again = where(wider < _MAX_WIDER, where(s["nodes"][0] < s["cap"][0], lacking, 0.0), 0.0)
    inner2 = s["radius2"][0]
    return {
        f"open{n}": [again], "wider": [wider], "inner2": [inner2],
        "radius2": [(1.0 + again) * inner2],
    }  # fmt: skip


def _with(values: Any, place: int, value: Any) -> list[Any]:
    """A copy with one value changed."""
    replaced = list(values)
    replaced[place] = value
    return replaced


def flow(n: int) -> Flow:
    """Reduce, then search the tree depth first: one loop per level, nested in the one above."""
    visit: Flow = ("leaf",)
    for level in range(n):
        visit = (f"enter{level}", Repeat(f"open{level}", (*visit, f"advance{level}")))
    again = Repeat(f"open{n}", (*visit, "widen"))
    return ("begin", Repeat("more", ("sweep",)), "reduce", "inverse", again)


@cache
def _search(n: int, kept: int) -> Traced:
    """The traced search for lattices of n dimensions that keeps ``kept`` points."""
    work: dict[str, Callable[[State], Outcome]] = {
        "begin": partial(begin, n=n, kept=kept), "sweep": partial(sweep, n=n),
        "reduce": partial(reduce, n=n), "leaf": partial(leaf, n=n, kept=kept),
        "inverse": partial(inverse, n=n), "widen": partial(widen, n=n),
        **{f"enter{i}": partial(enter, n=n, level=i) for i in range(n)},
        **{f"advance{i}": partial(advance, n=n, level=i) for i in range(n)},
    }  # fmt: skip
    return Traced(rows(n, kept), work, flow(n))
