"""The decision on a hold-out: few poses decide by their sum, many by more than chance."""

from __future__ import annotations

import numpy as np
import pytest

from longarm_comp.core.identify.proof import DECIDES, _better

SPREAD = 1e-4


def errors(rng: np.random.Generator, rows: int, size: float) -> np.ndarray:
    return SPREAD * rng.standard_normal((rows, 3)) + size


@pytest.mark.parametrize(("worse", "verdict"), [(1.05, False), (0.95, True)])
def test_a_small_hold_out_must_have_improved_at_all(
    worse: float, verdict: bool, rng: np.random.Generator
) -> None:
    before = errors(rng, 6, 0.0)
    after = worse * before
    spread = np.full((6, 3), SPREAD)
    assert (((before - after) / spread) ** 2).sum() < DECIDES
    assert _better(before, after, spread, rng) is verdict


def test_a_large_hold_out_must_have_improved_beyond_chance(rng: np.random.Generator) -> None:
    before, spread = errors(rng, 60, 3 * SPREAD), np.full((60, 3), SPREAD)
    assert _better(before, before - 3 * SPREAD, spread, rng)
    assert not _better(before - 3 * SPREAD, before, spread, rng)
    shuffled = before[rng.permutation(60)]
    assert (((before - shuffled) / spread) ** 2).sum() > DECIDES
    assert not _better(before, shuffled + 1e-12, spread, rng)
