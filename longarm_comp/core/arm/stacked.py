"""Computes many similar items at once: NumPy takes as long for short arrays as for long ones."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import Frame, Scalar, Twist, exp


def stack_alike(items: Mapping[Any, tuple[Scalar, ...]]) -> Iterator[tuple[list[Any], tuple]]:
    """Yield groups of k items that can be computed together: their keys and their stacked scalars.

    Items that hold arrays (N,) are stacked if the same scalars of them are 0.  Each scalar of the
    stack is (k, N), (k, 1) or 0.  Any other item is a group of its own: the same object.
    """
    kinds: dict[tuple[bool, ...], list[Any]] = {}
    for key, item in items.items():
        if any(type(x) is np.ndarray and x.ndim == 1 for x in item):
            zeros = tuple([type(x) is float and x == 0.0 for x in item])
            kinds.setdefault(zeros, []).append(key)
        else:
            yield [key], item
    for keys in kinds.values():
        for some in parts(keys, max(np.size(x) for x in items[keys[0]])):
            yield some, stack_all([items[key] for key in some])


def stack_all(items: Sequence[tuple[Scalar, ...]]) -> tuple[Scalar, ...]:
    """Stack the scalars of k items: each becomes (k, N), (k, 1), or 0 if it is 0 in all items."""
    made: list[Scalar] = []
    for each in zip(*items, strict=True):
        arrays = [x for x in each if type(x) is np.ndarray]
        if not arrays:
            zero = all(type(x) is float and x == 0.0 for x in each)
            made.append(0.0 if zero else np.array(each, dtype=float)[:, None])
            continue
        rows = np.empty((len(each), max([x.size for x in arrays])))
        for row, x in zip(rows, each, strict=True):
            row[:] = x
        made.append(rows)
    return tuple(made)


def parts(keys: Collection[Any], size: int) -> Iterator[list[Any]]:
    """Split keys of items into lists whose stacked arrays, each of `size`, fit into the cache."""
    each, count = list(keys), max(1, 32768 // max(size, 1))
    return (each[n : n + count] for n in range(0, len(each), count))


def take_apart(scalars: tuple[Scalar, ...], count: int) -> Iterator[tuple[Scalar, ...]]:
    """Yield the scalars of each of the `count` items of a group that `stack_alike` yields."""
    columns = [
        (list(x) if x.shape[1] != 1 else x[:, 0].tolist())
        if type(x) is np.ndarray and x.ndim == 2
        else [x] * count
        for x in scalars
    ]
    return zip(*columns, strict=True)


def exps(twists: Mapping[int, Twist]) -> dict[int, Frame]:
    """Return the motion `exp(twist)` of every twist, by station; similar twists are stacked."""
    made = {}
    for keys, twist in stack_alike(twists):
        n, o, a, p = alone = exp(twist)
        if twist is twists[keys[0]]:
            made[keys[0]] = alone
            continue
        for key, x in zip(keys, take_apart((*n, *o, *a, *p), len(keys)), strict=True):
            made[key] = Frame(x[:3], x[3:6], x[6:9], x[9:])  # type: ignore[arg-type]
    return made
