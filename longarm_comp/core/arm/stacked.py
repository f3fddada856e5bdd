"""Many items of the same kind in one computation: short arrays cost as much as long ones."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import Frame, Scalar, Twist, exp


def stack_alike(items: Mapping[Any, tuple[Scalar, ...]]) -> Iterator[tuple[list[Any], tuple]]:
    """Yield items of the same kind, stacked, so that one computation serves all of them.

    Items of arrays (N,) come together where the same scalars are 0: every scalar is then (k, N),
    (k, 1) or 0.  Others come alone, as they are.
    """
    kinds: dict[tuple[bool, ...], list[Any]] = {}
    for key, item in items.items():
        if any(isinstance(x, np.ndarray) and x.ndim == 1 for x in item):
            zeros = tuple(map(_zero, item))
            kinds.setdefault(zeros, []).append(key)
        else:
            yield [key], item
    for keys in kinds.values():
        for some in parts(keys, max(np.size(x) for x in items[keys[0]])):
            yield some, stack_all([items[key] for key in some])


def stack_all(items: Sequence[tuple[Scalar, ...]]) -> tuple[Scalar, ...]:
    """Stack the scalars of some items: each to (k, N), (k, 1), or 0 where all of them are 0."""
    made: list[Scalar] = []
    for each in zip(*items, strict=True):
        if all(map(_zero, each)):
            made.append(0.0)
            continue
        rows = np.empty((len(each), max(np.size(x) for x in each)))
        for row, x in zip(rows, each, strict=True):
            row[:] = x
        made.append(rows)
    return tuple(made)


def _zero(x: Scalar) -> bool:
    return type(x) is float and x == 0.0


def parts(keys: Collection[Any], size: int) -> Iterator[list[Any]]:
    """Split keys of items, each of `size` numbers, into lists that one array may hold."""
    each, count = list(keys), max(1, _NEAR // size)
    return (each[n : n + count] for n in range(0, len(each), count))


_NEAR = 32768
"""Numbers in an array of several items: what a processor keeps near."""


def one_of(scalars: tuple[Scalar, ...], row: int) -> tuple[Scalar, ...]:
    """Return the scalars of one of the items that `stack_alike` yields."""
    return tuple(
        [
            (x[row] if x.shape[1] > 1 else float(x[row, 0]))
            if isinstance(x, np.ndarray) and x.ndim == 2
            else x
            for x in scalars
        ]
    )


def exps(twists: Mapping[int, Twist]) -> dict[int, Frame]:
    """Return `exp` of every twist by station, those of the same kind at once."""
    made = {}
    for keys, twist in stack_alike(twists):
        n, o, a, p = exp(twist)
        for row, key in enumerate(keys):
            x = one_of((*n, *o, *a, *p), row)
            made[key] = Frame(x[:3], x[3:6], x[6:9], x[9:])  # type: ignore[arg-type]
    return made
