"""Newton-Raphson in the joint box, one target: the loop that is also compiled.

Written in what plain Python and numba share: numbers, loops, flat buffers.  The five
functions under "the machine" are all that differs: as they stand they call a kernel of
Python functions on lists; `newton_numba` swaps in calls of machine code on arrays.

Far from the target a step costs one load pass, for the twists are carried from one iterate to
the next; near it every residual is the model's own, with all its passes.  The Jacobian there
is corrected by Broyden's rule, or by differences where a step gained little.
"""

from __future__ import annotations

from typing import Any

from longarm_comp.core.box_step import Buffer, rotation_error

# The same figures drive the batch in `newton_batch`.
DIFFERENCE = 1e-6  # step of the differences, in ranges
RENEW = 3  # iterations for which differences serve
POOR = 0.1  # of the squared residual left after a step: then the Jacobian is made exact
FLOOR = 1e-13  # least damping, in (m per joint range)^2
STALL_AFTER = 6  # iterations without a fifth of progress that end a start
FIRST_DAMPING = 0.05
NEAR = 1e-6  # squared residual (m^2) from which on all load passes are made

# ------------------------------------------------------------------ the machine


def buffer(size: int) -> Buffer:
    """Working memory."""
    return [0.0] * size


def first(k: Any, q: Buffer, c: Buffer, x: Buffer, out: Buffer, y: Buffer) -> None:
    """y = twists of the rigid arm's loads."""
    k[0](q, c, x, out, y)


def step(k: Any, q: Buffer, c: Buffer, x: Buffer, out: Buffer, y: Buffer) -> None:
    """out = tip and Jacobian with twists x; y = twists of the loads there."""
    k[1](q, c, x, out, y)


def last(k: Any, q: Buffer, c: Buffer, x: Buffer, out: Buffer, y: Buffer) -> None:
    """out = tip and Jacobian with twists x."""
    k[2](q, c, x, out, y)


def least_squares(k: Any, m: int, J: Buffer, e: Buffer, free: Buffer, u: Buffer) -> None:
    """u = the damped step of `box_step.solve_damped`; the damping follows the n flags in free."""
    if m == 6:
        k[4](J, e, free, u, u)
    else:
        k[3](J, e, free, u, u)


# ------------------------------------------------------------------ the loop


def full(k: Any, q: Buffer, c: Buffer, x: Buffer, out: Buffer) -> None:
    """out = tip and Jacobian after all of the model's load passes; x = twists, work."""
    for i in range(k[5]):
        if i == 0:
            first(k, q, c, x, out, x)
        else:
            step(k, q, c, x, out, x)
    last(k, q, c, x, out, x)


def residual(out: Buffer, target: Buffer, length: float, m: int, e: Buffer, size: Buffer) -> None:
    """e = target less tip, rotations times `length`; size = position (m) and angle (rad)."""
    for i in range(3):
        e[i] = target[i] - out[i]
    size[0] = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) ** 0.5
    size[1] = 0.0
    if m == 6:
        size[1] = rotation_error(out, 3, target, 3, e, 3)
        for i in range(3, 6):
            e[i] = e[i] * length


def weighted(out: Buffer, span: Buffer, length: float, m: int, n: int, J: Buffer) -> None:
    """J (m, n) = change of -e per range of each joint."""
    for i in range(m):
        w = length if i >= 3 else 1.0
        for j in range(n):
            J[i * n + j] = out[12 + i * n + j] * span[j] * w


def squared(e: Buffer, m: int) -> Any:
    """e . e."""
    s = e[0] * e[0]
    for i in range(1, m):
        s = s + e[i] * e[i]
    return s


def differences(
    k: Any,
    n: int,
    m: int,
    q: Buffer,
    c: Buffer,
    target: Buffer,
    upper: Buffer,
    span: Buffer,
    length: float,
    e: Buffer,
    x: Buffer,
    out: Buffer,
    e2: Buffer,
    size: Buffer,
    J: Buffer,
) -> None:
    """J (m, n) by forward differences inside the box: how the sag moves is in it."""
    for j in range(n):
        held = q[j]
        h = DIFFERENCE
        if held + h * span[j] > upper[j]:
            h = -h
        q[j] = held + h * span[j]
        full(k, q, c, x, out)
        residual(out, target, length, m, e2, size)
        for i in range(m):
            J[i * n + j] = (e[i] - e2[i]) / h
        q[j] = held


def broyden(J: Buffer, e: Buffer, e2: Buffer, u: Buffer, m: int, n: int, sag: Buffer) -> None:
    """Correct sag so that J + sag explains what the step u did: e -> e2."""
    uu = 1e-300  # a step of nothing corrects nothing
    for j in range(n):
        uu = uu + u[j] * u[j]
    for i in range(m):
        miss = e[i] - e2[i]
        for j in range(n):
            miss = miss - (J[i * n + j] + sag[i * n + j]) * u[j]
        for j in range(n):
            sag[i * n + j] = sag[i * n + j] + miss * u[j] / uu


def box_step(
    k: Any,
    J: Buffer,
    e: Buffer,
    q: Buffer,
    lower: Buffer,
    upper: Buffer,
    span: Buffer,
    damping: float,
    m: int,
    n: int,
    u: Buffer,
    free: Buffer,
    left: Buffer,
    trial: Buffer,
) -> None:
    """trial = q after a damped least-squares step that stays in the box.

    A joint that would leave is put on its limit and the rest solved again, the furthest
    out first: at most n times.  Every joint is free again at the next iteration.
    """
    for i in range(m):
        left[i] = e[i]
    for j in range(n):
        free[j] = 1.0 if upper[j] > lower[j] else 0.0
        trial[j] = q[j]
    free[n] = damping
    for _ in range(n):
        least_squares(k, m, J, left, free, u)
        worst, out_by = -1, 0.0
        for j in range(n):
            if free[j] == 1.0:
                trial[j] = q[j] + u[j] * span[j]
                by = max(lower[j] - trial[j], trial[j] - upper[j]) / span[j]
                if by > out_by:
                    worst, out_by = j, by
        if worst < 0:
            break
        trial[worst] = lower[worst] if trial[worst] < lower[worst] else upper[worst]
        free[worst] = 0.0
        moved = (trial[worst] - q[worst]) / span[worst]
        for i in range(m):
            left[i] = left[i] - J[i * n + worst] * moved
    for j in range(n):  # every joint may have met its limit in the last round
        trial[j] = min(max(trial[j], lower[j]), upper[j])


def search(
    k: Any,
    n: int,
    m: int,
    nx: int,
    q: Buffer,
    c: Buffer,
    target: Buffer,
    lower: Buffer,
    upper: Buffer,
    span: Buffer,
    length: float,
    tol: float,
    max_iterations: int,
    found: Buffer,
) -> int:
    """Levenberg-Marquardt with an active set from q; q becomes the answer.

    Returns:
        Iterations used; `found` holds the position (m) and angle (rad) residuals at q by the
        model's full passes.
    """
    out, x, y = buffer(12 + 6 * n), buffer(nx), buffer(nx)
    e, e2, left, size = buffer(6), buffer(6), buffer(6), buffer(2)
    J, sag, exact = buffer(6 * n), buffer(6 * n), buffer(6 * n)
    u, free, trial = buffer(n), buffer(n + 1), buffer(n)

    full(k, q, c, x, out)
    residual(out, target, length, m, e, size)
    weighted(out, span, length, m, n, J)
    energy, near, true = squared(e, m), False, True  # true: e is by all load passes
    found[0], found[1] = size[0], size[1]
    mu, marked, since, poor, used, exact_at = FIRST_DAMPING, energy, 0, False, 0, -RENEW
    while True:
        ended = used >= max_iterations or since >= STALL_AFTER
        near = near or poor or energy < NEAR
        if not true and (poor or ended):
            true, poor = True, False
            full(k, q, c, y, out)
            residual(out, target, length, m, e, size)
            weighted(out, span, length, m, n, J)
            energy = squared(e, m)
            found[0], found[1] = size[0], size[1]
        if ended or (true and found[0] <= tol and found[1] <= tol):
            break
        if near and poor and used >= exact_at + RENEW:
            exact_at = used
            differences(k, n, m, q, c, target, upper, span, length, e, y, out, e2, size, exact)
            for i in range(m * n):
                sag[i] = exact[i] - J[i]
        for i in range(m * n):
            exact[i] = J[i] + sag[i]
        damping = mu * energy**0.5 + FLOOR
        box_step(k, exact, e, q, lower, upper, span, damping, m, n, u, free, left, trial)
        if near:
            full(k, trial, c, y, out)
        else:
            step(k, trial, c, x, out, x)
        residual(out, target, length, m, e2, size)
        energy2 = squared(e2, m)
        used += 1
        if true and near and exact_at < used - 1:
            for j in range(n):
                u[j] = (trial[j] - q[j]) / span[j]
            broyden(J, e, e2, u, m, n, sag)
        crossing = near and not true and energy2 < NEAR  # first true residual: not comparable
        poor = energy2 > POOR * energy and used > 2 and not crossing
        if energy2 < energy or crossing:
            for j in range(n):
                q[j] = trial[j]
            for i in range(m):
                e[i] = e2[i]
            weighted(out, span, length, m, n, J)
            energy = energy2
            mu = max(0.1 * mu, 1e-6)
            true = near
            if true:
                found[0], found[1] = size[0], size[1]
        else:
            poor = True
            mu = min(8.0 * mu + 1e-3, 1e6)
        if energy < 0.8 * marked:
            marked, since = energy, 0
        else:
            since += 1
    return used


def search_all(
    k: Any,
    m: int,
    nx: int,
    targets: Buffer,
    contexts: Buffer,
    starts: Buffer,
    lower: Buffer,
    upper: Buffer,
    span: Buffer,
    points: Buffer,
    length: float,
    tol: float,
    max_iterations: int,
    q: Buffer,
    report: Buffer,
) -> None:
    """Every target from its start, then from restarts until one holds.

    Args:
        targets: N rows of 12 (position, axes n o a); contexts: N rows.
        starts, lower, upper: N rows of n.
        points: restarts in the unit box, rows of n, each followed by its radius.
        q: N rows of n, the answers.
        report: N rows of position residual, angle residual, iterations, starts.
    """
    n = len(span)
    trial, found = buffer(n), buffer(2)
    for t in range(len(targets)):
        row, to, start, low, high = report[t], q[t], starts[t], lower[t], upper[t]
        row[0], row[1] = 1e300, 1e300
        for s in range(1 + len(points)):
            for j in range(n):
                trial[j] = start[j]
                if s > 0:
                    radius, size = points[s - 1][n], high[j] - low[j]
                    goal = low[j] + points[s - 1][j] * size
                    trial[j] = start[j] + radius * (goal - start[j])
                    trial[j] = min(max(trial[j], low[j]), high[j])
            row[2] += search(
                k, n, m, nx, trial, contexts[t], targets[t], low, high, span, length, tol,
                max_iterations, found,
            )  # fmt: skip
            row[3] += 1
            better = found[0] + length * found[1] < row[0] + length * row[1]
            if better:
                row[0], row[1] = found[0], found[1]
                for j in range(n):
                    to[j] = trial[j]
            if found[0] <= tol and found[1] <= tol:
                break
