"""The decision on a hold-out: few poses decide by their sum, many by more than chance."""

from __future__ import annotations

import numpy as np
import pytest

from longarm_comp.core.identify.proof import DECIDES, _better, _Unseen

SPREAD = 1e-4


def errors(rng: np.random.Generator, rows: int, size: float) -> np.ndarray:
    return SPREAD * rng.standard_normal((rows, 3)) + size


def better(before: np.ndarray, after: np.ndarray, rng: np.random.Generator) -> bool:
    held, spread = np.ones(before.shape, bool), np.full(before.shape, SPREAD)
    old, new = (_Unseen(error, held, spread, np.arange(3)) for error in (before, after))
    return _better(old, new, rng)


@pytest.mark.parametrize(("worse", "verdict"), [(1.05, False), (0.95, True)])
def test_a_small_hold_out_must_have_improved_at_all(
    worse: float, verdict: bool, rng: np.random.Generator
) -> None:
    before = errors(rng, 6, 0.0)
    after = worse * before
    assert (((before - after) / SPREAD) ** 2).sum() < DECIDES
    assert better(before, after, rng) is verdict


def test_a_large_hold_out_must_have_improved_beyond_chance(rng: np.random.Generator) -> None:
    before = errors(rng, 60, 3 * SPREAD)
    assert better(before, before - 3 * SPREAD, rng)
    assert not better(before - 3 * SPREAD, before, rng)
    shuffled = before[rng.permutation(60)]
    assert (((before - shuffled) / SPREAD) ** 2).sum() > DECIDES
    assert not better(before, shuffled + 1e-12, rng)
