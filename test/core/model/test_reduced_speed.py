"""Moves for a driver whose limits nobody told: no part of the arm goes faster than it should."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from small_arm import ARM, AWAY

from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.drive_errors import ServoQuantisation
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.masses import TipPayload
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
    turns = np.abs(np.diff(follow(at), axis=0)[:, ~ARM.slides]).max(axis=1) / at[1]
    for begins, ends in zip([0, *due], due, strict=False):  # as fast as it may be, and no faster
        leg = (at[1:] > begins) & (at[1:] <= ends)
        shares = speed[leg].max() / REDUCED_SPEED, turns[leg].max() / 0.5
        assert max(shares) == pytest.approx(1.0, abs=3e-3)


def test_a_short_move_takes_its_least_time_and_a_turn_of_the_tool_takes_its_own() -> None:
    here = ARM.mid
    assert times_at_reduced_speed(Model(ARM), here, here[None] + 1e-5, 0.5) == pytest.approx([0.5])
    half = times_at_reduced_speed(Model(ARM), ARM.lower, ARM.upper[None], 0.5, 0.125)
    whole = times_at_reduced_speed(Model(ARM), ARM.lower, ARM.upper[None], 0.5, 0.0625)
    assert whole == pytest.approx(2.0 * half)


def length(model: Model, way: np.ndarray) -> float:
    """The length of a way if all of it is as fast as its fastest piece and part, m."""
    steps = np.diff(outline(model, np.linspace(*way, 65)), axis=0)
    return float(64 * np.linalg.norm(steps, axis=-1).max())


@pytest.mark.parametrize("base", [(), (AWAY,)])
def test_a_sagging_arm_keeps_below_the_speed_and_is_hardly_slower_than_it_may_be(
    base: tuple[Effect, ...],
) -> None:
    soft = [JointCompliance(row, 2e-3) for row in JointCompliance.rows(ARM)]
    model = Model(ARM, (*soft, TipPayload(mass=2.0), *base))
    rng, slower = np.random.default_rng(3), []
    for size in np.geomspace(1e-3, 1.0, 30):
        way = np.clip(ARM.mid + size * (ARM.upper - ARM.lower) * rng.uniform(-1, 1, (2, ARM.n)),
                      ARM.lower, ARM.upper)  # fmt: skip
        (due,) = times_at_reduced_speed(model, way[0], way[1:], 0.2)
        turned = np.abs(np.diff(way, axis=0))[0, ~ARM.slides].max() / 0.5
        needed = max(0.2, 1.5 * length(model, way) / REDUCED_SPEED, 1.5 * turned)
        slower.append(due / needed)
    assert min(slower) >= 1.0
    assert max(slower) < 1.3


def test_a_servos_rounding_is_no_motion_on_the_way() -> None:
    way = ARM.mid + 0.1 * np.array([[0.0], [1.0]]) * (ARM.upper - ARM.lower)
    steps = [ServoQuantisation(row, steps_per_turn=500) for row in ServoQuantisation.rows(ARM)]
    rounded = times_at_reduced_speed(Model(ARM, tuple(steps)), way[0], way[1:], 0.01)
    assert rounded == pytest.approx(times_at_reduced_speed(Model(ARM), way[0], way[1:], 0.01))


def test_a_short_move_needs_no_outline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(reduced_speed, "outline")
    way = np.array([ARM.mid + 1e-4, ARM.mid])
    assert times_at_reduced_speed(Model(ARM), ARM.mid, way, 0.5).tolist() == [0.5, 1.0]
