"""Newton-Raphson search in the joint box, written once for every engine.

The state of a search is a column of numbers (`rows`).  The functions here read and write it without
a branch on data: they run on floats for one target, on arrays for many, and traced as machine code
for the lanes of a processor.  `flow` is the order in which they run.

The tip is evaluated at three levels (`LEVELS`).  While it is far from the target, the twists of the
start are kept.  Then twists are carried from one iterate to the next, with one load pass per step.
Near the target the model itself is evaluated with all its passes.  On the last two levels Broyden's
rule corrects the Jacobian, which otherwise keeps the sag constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from longarm_comp.core.arm.spatial import absolute, atan2, maximum, minimum, sqrt, where

_Scalars = Sequence[Any]  # floats, arrays (N,) or traced numbers


def _solve_damped(J: _Scalars, e: _Scalars, free: _Scalars, damping: Any, m: int) -> list[Any]:
    """Compute the damped least-squares solution u of ``J F u = e``.

    ``u = F J' (J F J' + damping 1)^-1 e``.

    Args:
        J: m x n numbers, row after row.
        e: m numbers.
        free: n numbers, the diagonal of F: 1 for a free unknown, 0 for a fixed one.
        damping: above 0, so that the Cholesky factor exists.
    """
    n, A, y, u = len(free), [0.0] * (m * m), [0.0] * m, []  # A: factor below the pivots
    for i in range(m):
        for j in range(i + 1):
            s = (J[j * n] * free[0]) * J[i * n]
            for k in range(1, n):
                s = s + (J[j * n + k] * free[k]) * J[i * n + k]
            A[i * m + j] = s
        A[i * m + i] = A[i * m + i] + damping
    for j in range(m):  # A = L D L'
        pivot = A[j * m + j]
        for k in range(j):
            pivot = pivot - A[j * m + k] * A[j * m + k] * A[k * m + k]
        A[j * m + j] = pivot
        for i in range(j + 1, m):
            s = A[i * m + j]
            for k in range(j):
                s = s - A[i * m + k] * A[j * m + k] * A[k * m + k]
            A[i * m + j] = s / pivot
    for i in range(m):
        s = e[i]
        for k in range(i):
            s = s - A[i * m + k] * y[k]
        y[i] = s
    for i in range(m - 1, -1, -1):
        s = y[i] / A[i * m + i]
        for k in range(i + 1, m):
            s = s - A[k * m + i] * y[k]
        y[i] = s
    for k in range(n):
        s = J[k] * y[0]
        for i in range(1, m):
            s = s + J[i * n + k] * y[i]
        u.append(s * free[k])
    return u


def rotation_error(R: _Scalars, target: _Scalars) -> tuple[list[Any], Any]:
    """Return the rotation vector (rad, base frame) from R to the target, and its angle, 0 to pi.

    Both hold axes n, o, a one after the other, 9 numbers each.  At an angle of pi the vector is 0.
    """
    x = y = z = trace = 0.0  # sum of the cross products of the axes, and of their scalar products
    for k in (0, 3, 6):
        (a0, a1, a2), (b0, b1, b2) = R[k : k + 3], target[k : k + 3]
        x = x + (a1 * b2 - a2 * b1)
        y = y + (a2 * b0 - a0 * b2)
        z = z + (a0 * b1 - a1 * b0)
        trace = trace + (a0 * b0 + a1 * b1 + a2 * b2)
    x, y, z = 0.5 * x, 0.5 * y, 0.5 * z
    s = sqrt(x * x + y * y + z * z)
    angle = atan2(s, 0.5 * (trace - 1.0))
    ratio = angle / (s + 1e-300)
    return [ratio * x, ratio * y, ratio * z], angle


def skewness(R: _Scalars) -> Any:
    """Return how far axes n, o, a (9 numbers) are from a right-handed rotation.

    It is the sum of squares of the elements of ``R'R - 1`` (each once) and of ``n x o - a``.
    """
    s = 0.0
    for i in range(3):
        for j in range(i + 1):
            d = R[3 * i] * R[3 * j]
            d = d + R[3 * i + 1] * R[3 * j + 1] + R[3 * i + 2] * R[3 * j + 2]
            if i == j:
                d = d - 1.0
            s = s + d * d
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        d = R[j] * R[3 + k] - R[k] * R[3 + j] - R[6 + i]
        s = s + d * d
    return s


State = Mapping[str, _Scalars]
Outcome = dict[str, _Scalars]

MAX_ITERATIONS = 60
"""Iterations from one start."""
UNKNOWN = 1e300  # energy (m^2) before the first evaluation
_FLOOR = 1e-13  # least damping, in (m per joint range)^2: a third of a micrometre
REACHED = 1e-6
"""Tolerance of success, m and rad, and of what counts as a rotation. On the boundary of the
reachable space, the last digits of a target decide whether any joints meet it more closely."""


class Level(NamedTuple):
    """A way to evaluate the tip, and the residual (m and rad) down to which it is used.

    Twists are "kept" from the start of the level, "carried" from iterate to iterate, or from "full"
    load passes.
    """

    evaluate: str  # "kept", "carried" or "full"
    near: float | None  # residual at which the level ends; None: `tol`
    skip: float | None  # residual at its start at which it ends at once; None: `tol`
    hasty: bool  # whether a step with little progress ends it too
    learns: bool  # whether Broyden's rule corrects the Jacobian


LEVELS = (
    Level("kept", 0.1, 0.1, False, False),
    Level("carried", 1e-6, 5e-3, True, True),  # a first load pass may miss by 4 mm of 100
    Level("full", None, None, False, True),
)


def rows(n: int, context: int, twists: int) -> dict[str, range]:
    """Return the rows of a search's state by name: inputs, then results, then working quantities.

    `live` is 0 in an unused column.

    Args:
        n: number of joints.
        context: number of scalars of the context.
        twists: number of components of twists.
    """
    sizes = {
        "given": 16,
        "seed": n,
        "live": 1,
        "tol": 1,
        "length": 1,
        "permitted": 1,
        "lower": n,
        "upper": n,
        "c": context,
        "q": n,
        "size": 2,
        "used": 1,
        "fault": 1,
        "target": 12,
        "trial": n,
        "x": twists,
        "out": 12 + 6 * n,
        "e": 6,
        "J": 6 * n,
        "sag": 6 * n,
        "left": 6,
        "free": n,
        "energy": 1,
        "mu": 1,
        "marked": 1,
        "since": 1,
        "open": 1,
        "more": 1,
    }
    layout, at = {}, 0
    for name, size in sizes.items():
        layout[name] = range(at, at + size)
        at += size
    return layout


# ------------------------------------------------------------------ what is traced


def accept(s: State, m: int) -> Outcome:
    """Begin a search: take the target (4 x 4, row after row), and the seed clipped to the limits.

    ``fault`` is 0, or the sum of 1 if a number is not finite and 2 if the target is no pose.
    """
    T = s["given"]
    axes = [T[4 * i + j] for j in range(3) for i in range(3)]
    size: Any = 0.0
    for v in (*T, *s["seed"]):
        size = size + absolute(v)
    fault: Any = where(size < UNKNOWN, 0.0, 1.0)
    if m == 6:
        bottom = absolute(T[12]) + absolute(T[13]) + absolute(T[14]) + absolute(T[15] - 1.0)
        whole = (skewness(axes) < REACHED**2) * (bottom <= 0.0)
        fault = fault + where(whole, 0.0, 2.0)
    q = [
        minimum(maximum(v, low), high)
        for v, low, high in zip(s["seed"], s["lower"], s["upper"], strict=True)
    ]
    return {"target": [T[3], T[7], T[11], *axes], "q": q, "fault": [fault]}


def begin_search(n: int) -> Outcome:
    """Return the state of n joints before the first evaluation."""
    return {
        "e": [0.0] * 6,
        "J": [0.0] * (6 * n),
        "sag": [0.0] * (6 * n),
        "used": [0.0],
        "mu": [0.05],
        "size": [UNKNOWN, UNKNOWN],
    }


def open_level(s: State) -> Outcome:
    """Begin a level: the present joints are its first trial, to be evaluated anew."""
    return {
        "trial": s["q"],
        "energy": [UNKNOWN],
        "marked": [UNKNOWN],
        "since": [0.0],
        "open": s["live"],
    }


def judge(s: State, span: Sequence[float], m: int, level: Level) -> Outcome:
    """Accept or reject the evaluated trial (Levenberg-Marquardt) and prepare the next."""
    n, out, J, sag, length = len(span), s["out"], s["J"], s["sag"], s["length"][0]
    e: list[Any] = [s["target"][i] - out[i] for i in range(3)] + [0.0] * 3
    size: list[Any] = [sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2]), 0.0]
    if m == 6:
        turn, size[1] = rotation_error(out[3:12], s["target"][3:])
        e[3:] = [length * v for v in turn]
    energy: Any = 0.0
    for i in range(m):
        energy = energy + e[i] * e[i]
    was, is_open = s["energy"][0], s["open"][0]
    fresh, better = was >= UNKNOWN, energy < was
    take = better * is_open
    go_on = is_open * (1.0 - fresh)

    u = [(t - q) / w for t, q, w in zip(s["trial"], s["q"], span, strict=True)]
    square: Any = 1e-300  # avoids a division by zero for a zero step
    for v in u:
        square = square + v * v
    gain = go_on / square if level.learns else 0.0
    learnt: list[Any] = []
    for i in range(m):
        miss = s["e"][i] - e[i]
        for j in range(n):
            miss = miss - (J[i * n + j] + sag[i * n + j]) * u[j]
        learnt += [sag[i * n + j] + gain * miss * u[j] for j in range(n)]

    weights = [w * (length if i >= 3 else 1.0) for i in range(m) for w in span]
    J = [where(take, w * out[12 + k], J[k]) for k, w in enumerate(weights)]
    e = [where(take, new, old) for new, old in zip(e[:m], s["e"], strict=False)]
    size = [where(take, new, old) for new, old in zip(size, s["size"], strict=True)]
    q = [where(take, new, old) for new, old in zip(s["trial"], s["q"], strict=True)]
    used = s["used"][0] + go_on
    # share of the squared residual after a step that is too large with carried twists
    poor = where(better, (energy > 0.1 * was) * (used > 2.5), 1.0)
    mu = s["mu"][0]
    changed = where(better, maximum(0.1 * mu, 1e-6), minimum(8.0 * mu + 1e-3, 1e6))
    energy = where(take, energy, was)
    moved = energy < 0.8 * s["marked"][0]
    since = where(moved, 0.0, s["since"][0] + 1.0)
    near = s["tol"][0]
    if level.near is not None:
        near = where(fresh, level.skip, level.near)
    arrived = (size[0] <= near) * (size[1] <= near)
    # iterations with less than a fifth of progress that end a level
    ended = (used >= s["permitted"][0]) + (since >= 6) + arrived
    if level.hasty:
        ended = ended + poor
    return {
        "q": q,
        "e": e,
        "J": J,
        "sag": learnt,
        "size": size,
        "used": [used],
        "energy": [energy],
        "mu": [where(go_on, changed, mu)],
        "marked": [where(moved, energy, s["marked"][0])],
        "since": [since],
        "open": [where(ended, 0.0, is_open)],
        "left": e,
        "trial": q,
        "free": [where(a < b, 1.0, 0.0) for a, b in zip(s["lower"], s["upper"], strict=True)],
    }


def step_in_box(s: State, span: Sequence[float], m: int) -> Outcome:
    """Return one round of the damped least-squares step that stays in the box.

    The joint that would leave the box farthest is put on its limit and the others are solved again
    (`more`), at most n times.  All joints are free again at the next iteration.
    """
    n, free, left = len(span), s["free"], s["left"]
    J = [a + b for a, b in zip(s["J"][: m * n], s["sag"], strict=False)]
    damping = s["mu"][0] * sqrt(s["energy"][0]) + _FLOOR
    u = _solve_damped(J, left, free, damping, m)
    trial, out_by = [], []
    for j in range(n):
        moved = where(free[j], s["q"][j] + u[j] * span[j], s["trial"][j])
        inside = minimum(maximum(moved, s["lower"][j]), s["upper"][j])
        trial.append(inside)
        out_by.append(free[j] * absolute(moved - inside) / span[j])
    worst: Any = out_by[0]
    for by in out_by[1:]:
        worst = maximum(worst, by)
    more = where(worst > 0.0, 1.0, 0.0)
    left, kept, still = list(left[:m]), [], more
    for j in range(n):  # the first of those that are farthest outside
        put = still * (out_by[j] >= worst)
        still = still - put
        kept.append(free[j] - put)
        change = put * (trial[j] - s["q"][j]) / span[j]
        left = [left[i] - J[i * n + j] * change for i in range(m)]
    return {"trial": trial, "free": kept, "left": left, "more": [more]}


# ------------------------------------------------------------------ the order of the programs


@dataclass(frozen=True)
class Repeat:
    """Programs that are repeated while a row of the state is not 0."""

    row: str
    body: Flow


Flow = tuple["str | Repeat", ...]


def flow(passes: int, m: int) -> Flow:
    """Return the programs of a search in their order; it starts at q and leaves its result there.

    Args:
        passes: load passes of the model.
        m: number of equations, 3 or 6.
    """
    steps: list[str | Repeat] = ["begin"]
    step = f"round{m}", Repeat("more", (f"round{m}",))
    for level in LEVELS:
        judged = f"judge{m}_{level.evaluate}"
        again = Repeat("open", (*step, *evaluation(level, passes, False), judged))
        steps += ["open", *evaluation(level, passes, True), judged, again]
    return tuple(steps)


def evaluation(level: Level, passes: int, anew: bool) -> tuple[str, ...]:
    """Return the names of the programs that evaluate the trial joints, in order.

    Args:
        passes: load passes of a full evaluation.
        anew: the level begins, so no twists of an earlier evaluation can be reused.
    """
    if level.evaluate == "full":
        return ("first", *["again"] * (passes - 1), "tip") if passes else ("tip",)
    if anew:
        return ("first", "tip")
    return ("again", "tip") if level.evaluate == "carried" else ("tip",)
