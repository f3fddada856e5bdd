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
        if not _all_floats(item) and any(isinstance(x, np.ndarray) and x.ndim == 1 for x in item):
            zeros = tuple(map(_zero, item))
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
        sizes = [x.size for x in each if isinstance(x, np.ndarray)]
        if not sizes:
            made.append(0.0 if all(map(_zero, each)) else np.array(each, dtype=float)[:, None])
            continue
        rows = np.empty((len(each), max(sizes)))
        for row, x in zip(rows, each, strict=True):
            row[:] = x
        made.append(rows)
    return tuple(made)


def _all_floats(scalars: tuple[Scalar, ...]) -> bool:
    return set(map(type, scalars)) == {float}


def _zero(x: Scalar) -> bool:
    return type(x) is float and x == 0.0


def parts(keys: Collection[Any], size: int) -> Iterator[list[Any]]:
    """Split keys of items into lists whose stacked arrays, each of `size`, fit into the cache."""
    each, count = list(keys), max(1, 32768 // size)
    return (each[n : n + count] for n in range(0, len(each), count))


def one_of(scalars: tuple[Scalar, ...], row: int) -> tuple[Scalar, ...]:
    """Return the scalars of item `row` of a group that `stack_alike` yields."""
    if _all_floats(scalars):
        return scalars
    return tuple(
        [
            (x[row] if x.shape[1] > 1 else float(x[row, 0]))
            if isinstance(x, np.ndarray) and x.ndim == 2
            else x
            for x in scalars
        ]
    )


def exps(twists: Mapping[int, Twist]) -> dict[int, Frame]:
    """Return the motion `exp(twist)` of every twist, by station; similar twists are stacked."""
    made = {}
    for keys, twist in stack_alike(twists):
        n, o, a, p = alone = exp(twist)
        if twist is twists[keys[0]]:
            made[keys[0]] = alone
            continue
        for row, key in enumerate(keys):
            x = one_of((*n, *o, *a, *p), row)
            made[key] = Frame(x[:3], x[3:6], x[6:9], x[9:])  # type: ignore[arg-type]
    return made
