"""Rows set aside as outliers: a group where they share one displacement, else none."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from hidden_arm import SIGMA, session
from scipy.special import logsumexp
from scipy.stats import multivariate_t, norm
from small_arm import ARM

from longarm_comp.core.effects.shapes import Switch
from longarm_comp.core.identify.calibrate import declared_model, stages
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.discover.bank import Spot
from longarm_comp.core.identify.discover.inputs import Argument, Arguments
from longarm_comp.core.identify.discover.search import _State
from longarm_comp.core.identify.discover.set_aside import LINE, TAILS, _separating, shared
from longarm_comp.core.identify.model_fit import ModelFit

ROWS = 120


@cache
def calibrated() -> ModelFit:
    *_, (_, fitted) = stages(declared_model(ARM), session())
    return fitted


def left(errors: np.ndarray, own: float = 0.0) -> ModelFit:
    """A fit whose first rows are set aside with such errors (n, 3) m, and an uncertainty (m)."""
    sound = calibrated()
    residual, columns = sound.residual.copy(), np.zeros((ROWS, 3, 3))
    residual[: len(errors)], columns[:] = errors, own * np.eye(3)
    return dataclasses.replace(
        sound,
        residual=residual,
        columns=columns,
        covariance=np.eye(3),
        sigma=np.full(3, SIGMA),
        weights=(np.arange(ROWS) >= len(errors)).astype(float),
    )


def one_way(count: int, rng: np.random.Generator) -> tuple[list[Spot], np.ndarray]:
    """Components that move the tip by a random way in every row; by 1 m a unit."""
    units = rng.standard_normal((ROWS, 3, count))
    spots = [Spot(f"joint {k}", "turn z") for k in range(count)]
    return spots, units / np.linalg.norm(units, axis=1, keepdims=True)


def test_the_evidence_is_that_of_two_kinds_of_rows(rng: np.random.Generator) -> None:
    """By quadrature over the amount, against outliers alone: 8 of 14 rows share 2 mm."""
    spots, units = one_way(30, rng)
    errors = SIGMA * rng.standard_normal((14, 3))
    errors[:8] += 2e-3 * units[:8, :, 4]
    errors[8:] += 4e-3 * rng.standard_normal((6, 3))
    found = shared(left(errors), [(spots, units)])
    assert found is not None
    np.testing.assert_array_equal(np.flatnonzero(found.rows), np.arange(8))
    white = errors / SIGMA
    wide = (white.T @ white + 3 * LINE**2 * np.eye(3)) / len(white)
    for _ in range(30):  # the most probable scale of Student's law
        law = multivariate_t(np.zeros(3), wide, df=TAILS)
        far = (white * np.linalg.solve(wide, white.T).T).sum(axis=1)
        counted = white * ((TAILS + 3) / (TAILS + far))[:, None]
        wide = (counted.T @ white + 3 * LINE**2 * np.eye(3)) / len(white)
    out = law.logpdf(white)
    amounts = np.linspace(-4e-3, 4e-3, 4001)
    moved = amounts[:, None, None] * units[:14, :, 4] / SIGMA
    inside = norm.logpdf(white - moved).sum(axis=2)
    rows = (np.logaddexp(inside, out) - np.log(2.0) - out).sum(axis=1)
    prior = norm(0.0, 2e-3).logpdf(amounts) + np.log(amounts[1] - amounts[0])
    expected = logsumexp(rows + prior) - np.log(len(spots))
    assert found.log_evidence == pytest.approx(expected, abs=1.0)


def test_rows_that_the_fit_knows_less_of_may_differ_more(rng: np.random.Generator) -> None:
    spots, units = one_way(1, rng)
    errors = 8e-3 * units[:12, :, 0] + 5 * SIGMA * rng.standard_normal((12, 3))
    assert shared(left(errors), [(spots, units)]) is None
    found = shared(left(errors, own=5 * SIGMA), [(spots, units)])
    assert found is not None
    assert found.rows.sum() == 12


@pytest.mark.parametrize("rows", [8, 24])
def test_errors_along_one_sight_are_outliers(rows: int, rng: np.random.Generator) -> None:
    """Depth that is wrong by 1.5 to 6 mm, whatever the row."""
    moves = [Spot("base", f"move {axis}") for axis in "xyz"]
    units = np.broadcast_to(np.eye(3), (ROWS, 3, 3))
    for _ in range(60):
        size = rng.uniform(1.5e-3, 6e-3, (rows, 1)) * rng.choice([-1.0, 1.0], (rows, 1))
        errors = size * [0.3, 0.94, 0.16] + SIGMA * rng.standard_normal((rows, 3))
        assert shared(left(errors), [(moves, units)]) is None


def test_a_switch_lies_where_it_tells_the_group_from_the_rest() -> None:
    """Between values, on either side, those with fewer errors first; the rest is not tried."""
    group = np.arange(40) < 6
    high = np.where(group, 0.9, np.linspace(0.0, 0.8, 40))
    low = np.where(group, -1.0, 1.0) + np.where(np.arange(40) == 20, -2.0, 0.0)
    other = np.tile([0.0, 1.0], 20)
    named = (("q1", low), ("q2", high), ("q3", other))
    inputs = Arguments(tuple(Argument(name, v, 20) for name, v in named), (), 3)
    first, second = _separating(inputs, group, np.ones(40, bool))
    assert isinstance(first, Switch)
    assert (first.of, second.of) == ("q2", "q1")
    assert first.threshold == pytest.approx(0.85)
    assert second.threshold == pytest.approx(0.0)


def test_a_switch_that_brings_back_a_part_only_is_not_added() -> None:
    """Of 12 rows with one displacement 7 lie lowest in the first joint."""
    rows = session()
    group = np.zeros(ROWS, bool)
    order = np.argsort(rows.q[:, 0])
    group[order[[*range(7), 20, 44, 61, 83, 102]]] = True
    shifted = dataclasses.replace(rows, xyz=rows.xyz + np.outer(group, [1e-3, -2e-3, 2e-3]))
    *_, (_, fitted) = stages(declared_model(ARM), shifted)
    state = _State(fitted, None)
    before = state.fit
    said: list[str] = []
    assert not state.give_back(said.append)
    assert said
    assert state.fit is before
    assert not state.groups


def test_a_diagnosis_says_that_rows_left_out_share_a_displacement() -> None:
    """Nothing tells them from the others."""
    rows = session()
    group = np.arange(ROWS) % 12 == 7
    shifted = dataclasses.replace(rows, xyz=rows.xyz + np.outer(group, [1e-3, -2e-3, 2e-3]))
    result = diagnose(ARM, shifted, test=session(n=40, seed=9), kinds=())
    assert result.added is None
    assert result.verdict == "unknown"
    assert result.structure.sign.startswith("shows in rows left out: 10 of 120 share one")
