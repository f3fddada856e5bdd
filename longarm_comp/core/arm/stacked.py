"""Many items of the same kind in one computation: short arrays cost as much as long ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import Frame, Scalar, Twist, exp


def alike(items: Mapping[Any, tuple[Scalar, ...]]) -> Iterator[tuple[list[Any], tuple]]:
    """Items of the same kind, stacked, so that one computation serves all of them.

    An item is some scalars.  Items of arrays (N,) come together where the same scalars are 0: every
    scalar is then (k, N), (k, 1) or 0.  Others come alone, as they are.
    """
    kinds: dict[tuple[bool, ...], list[Any]] = {}
    for key, item in items.items():
        if any(isinstance(x, np.ndarray) and x.ndim == 1 for x in item):
            zeros = tuple([type(x) is float and x == 0.0 for x in item])
            kinds.setdefault(zeros, []).append(key)
        else:
            yield [key], item
    for zeros, keys in kinds.items():
        size = max(np.size(x) for x in items[keys[0]])
        # Numbers in an array of several items: what a processor keeps near
        count = max(1, 32768 // size)
        for some in (keys[n : n + count] for n in range(0, len(keys), count)):
            columns = zip(zeros, zip(*(items[key] for key in some), strict=True), strict=True)
            yield some, tuple([0.0 if zero else _stacked(column) for zero, column in columns])


def _stacked(scalars: Sequence[Scalar]) -> np.ndarray:
    """(k, N) or (k, 1) of k floats or arrays (N,)."""
    made = np.empty((len(scalars), max(np.size(x) for x in scalars)))
    for row, x in zip(made, scalars, strict=True):
        row[:] = x
    return made


def one_of(scalars: tuple[Scalar, ...], row: int) -> tuple[Scalar, ...]:
    """The scalars of one of several items that `alike` stacked, or of one that came alone."""
    return tuple([
        x if not isinstance(x, np.ndarray) or x.ndim < 2 else x[row] if x.shape[1] > 1
        else float(x[row, 0])
        for x in scalars
    ])  # fmt: skip


def exps(twists: Mapping[int, Twist]) -> dict[int, Frame]:
    """`exp` of many twists."""
    made = {}
    for keys, twist in alike(twists):
        n, o, a, p = exp(twist)
        for row, key in enumerate(keys):
            x = one_of((*n, *o, *a, *p), row)
            made[key] = Frame(x[:3], x[3:6], x[6:9], x[9:])  # type: ignore[arg-type]
    return made
