"""Nearest points of a lattice: against every combination."""

import itertools

import numpy as np
import pytest

from longarm_comp.core.ik.lattice import nearest


def lattices(rng: np.random.Generator, n: int, count: int = 40, price: float = 0.05) -> np.ndarray:
    """(count, n, n + 1): factors of three equations and a price, and what is to be made zero."""
    A = np.concatenate(
        [rng.normal(size=(count, 3, n)), np.broadcast_to(price * np.eye(n), (count, n, n))], 1
    )
    b = np.concatenate([rng.normal(size=(count, 3, 1)), rng.normal(size=(count, n, 1)) * price], 1)
    made: np.ndarray = np.linalg.qr(np.concatenate([A, b], 2), mode="r")[:, :n]  # type: ignore[call-overload]
    return made


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_the_nearest_points_are_those_of_brute_force(n: int, rng: np.random.Generator) -> None:
    R = lattices(rng, n, price=0.3)
    low, high = rng.integers(-3, 0, (40, n)), rng.integers(1, 4, (40, n))
    full = 0
    for i in range(len(R)):
        found, _ = nearest(R[i], low[i], high[i], kept=4, max_nodes=100_000)
        steps = (np.arange(a, b + 1) for a, b in zip(low[i], high[i], strict=True))
        k = np.array(list(itertools.product(*steps)), float)
        distance2 = ((k @ R[i, :, :n].T + R[i, :, n]) ** 2).sum(axis=1)
        order = np.argsort(distance2)[:4]
        have = len(found)
        full += have == min(4, len(k))
        np.testing.assert_array_equal(found, k[order[:have]])
    assert full >= 36  # where the box lies far off, its points are not worth the search


def test_a_search_ends_at_its_nodes(rng: np.random.Generator) -> None:
    box = np.full(6, 40.0)
    for R in lattices(rng, 6, 9):
        (short, few), (whole, many) = (nearest(R, -box, box, max_nodes=m) for m in (20, 10_000))
        assert few <= 20 < many
        assert len(whole) == 16
        first, best = (np.linalg.norm(R[:, :6] @ k[0] + R[:, 6]) for k in (short, whole))
        assert first >= best
