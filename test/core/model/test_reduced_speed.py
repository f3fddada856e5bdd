"""Moves for a driver whose limits nobody told: no part of the arm goes faster than it should."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from small_arm import ARM

from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.model import reduced_speed
from longarm_comp.core.model.link_frames import outline
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.reduced_speed import REDUCED_SPEED, times_at_reduced_speed


@pytest.mark.parametrize("seed", range(5))
def test_a_controller_that_follows_cubics_keeps_every_part_below_the_speed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, *points = rng.uniform(ARM.lower, ARM.upper, (4, ARM.n))
    due = times_at_reduced_speed(Model(ARM), start, np.array(points), 0.01)
    still = np.zeros((4, ARM.n))
    follow = CubicHermiteSpline([0.0, *due], [start, *points], still)
    at = np.linspace(0.0, due[-1], 4001)
    line = outline(Model(ARM), follow(at))
    speed = np.linalg.norm(np.diff(line, axis=0), axis=-1).max(axis=1) / np.diff(at)
    legs = [speed[(at[1:] > a) & (at[1:] <= b)].max() for a, b in zip([0, *due], due, strict=False)]
    assert max(legs) <= 1.01 * REDUCED_SPEED
    turns = np.abs(np.diff(follow(at), axis=0)[:, ~ARM.slides]).max() / at[1]
    assert max(legs) > 0.6 * REDUCED_SPEED or turns > 0.45  # and not much slower than it may
    assert turns <= 0.501


def test_a_short_move_takes_its_least_time_and_a_turn_of_the_tool_takes_its_own() -> None:
    here = ARM.mid
    assert times_at_reduced_speed(Model(ARM), here, here[None] + 1e-5, 0.5) == pytest.approx([0.5])
    half = times_at_reduced_speed(Model(ARM), ARM.lower, ARM.upper[None], 0.5, 0.125)
    whole = times_at_reduced_speed(Model(ARM), ARM.lower, ARM.upper[None], 0.5, 0.0625)
    assert whole == pytest.approx(2.0 * half)


def test_a_bound_replaces_the_outline_only_where_the_least_time_suffices(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    soft = [JointCompliance(row, 1e-3) for row in ARM.commanded if not ARM.slides[row - 1]]
    model, rng = Model(ARM, tuple(soft)), np.random.default_rng(3)
    sizes = np.geomspace(1e-4, 1.0, 25)[:, None, None]
    ways = ARM.mid + 0.5 * sizes * (ARM.upper - ARM.lower) * rng.uniform(-1, 1, (25, 2, ARM.n))

    def times() -> np.ndarray:
        return np.array([times_at_reduced_speed(model, ARM.mid, way, 0.5) for way in ways])

    fast = times()
    with monkeypatch.context() as patch:
        patch.setattr(reduced_speed, "most_motion", lambda model: np.full((1, ARM.n), np.inf))
        np.testing.assert_array_equal(fast, times())
    monkeypatch.delattr(reduced_speed, "outline")  # a short move needs none
    assert times_at_reduced_speed(model, ARM.mid, ways[0], 0.5).tolist() == [0.5, 1.0]
