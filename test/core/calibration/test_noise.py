"""The noise as a rich fit leaves it: no axis may be fitted exactly."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hidden_arm import SIGMA, at, session
from small_arm import ARM

from longarm_comp.core.calibration.noise import from_residual
from longarm_comp.core.data.measured_rows import ChannelBlock
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.sim.hidden import drives

NOISE = 2e-5
"""m, of every axis."""
ROWS, COLUMNS = 40, 200


def fit_of(residual: np.ndarray) -> Any:
    """A fit of nothing, which leaves so much (N, 3)."""
    rows = len(residual)
    session = SimpleNamespace(
        measured=np.ones((rows, 3), dtype=bool),
        claimed={},
        uneven=lambda _: np.ones(rows),
        blocks=(ChannelBlock("position"),),
        channels=("x", "y", "z"),
    )
    return SimpleNamespace(
        columns=np.zeros((rows, 3, 0)),
        slots=(),
        residual=residual,
        weights=np.ones(rows),
        sigma=np.full(3, 1e-3),
        model=SimpleNamespace(values=np.zeros(0)),
        session=session,
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("smallest", [1e-7, 1e-6, 1e-5])
def test_more_columns_than_equations_do_not_make_the_noise_vanish(
    smallest: float, seed: int
) -> None:
    """One effect is there, of a library of directions that move the tip by 10 mm to so little."""
    rng = np.random.default_rng(seed)
    sizes = np.geomspace(1e-2, smallest, COLUMNS)
    directions = np.linalg.qr(rng.standard_normal((3 * ROWS, 3 * ROWS)))[0][:, : COLUMNS // 2]
    extra = np.concatenate([directions, rng.permuted(directions, axis=1)], axis=1) * sizes
    seen = (directions[:, 3] * sizes[3]).reshape(ROWS, 3) + NOISE * rng.standard_normal((ROWS, 3))
    noise, weights = from_residual(fit_of(seen), extra.reshape(ROWS, 3, COLUMNS))
    assert (noise.sigma > NOISE / 3).all()
    assert (noise.sigma < NOISE * 2).all()
    assert (weights == 1.0).all()


def test_every_axis_counts_its_own_freedom() -> None:
    """A depth three times as noisy as the rest, and a library that moves x alone."""
    true, rng = np.array([1.0, 3.0, 1.0]) * NOISE, np.random.default_rng(0)
    extra = np.zeros((200, 3, 120))
    extra[:, 0] = 1e-2 * rng.standard_normal((200, 120))
    noise, _ = from_residual(fit_of(true * rng.standard_normal((200, 3))), extra)
    assert noise.sigma == pytest.approx(true, rel=0.15)


def test_six_poses_that_can_be_fitted_exactly_keep_a_noise() -> None:
    """By a noise of nothing no prior would count, and rows held out would be met exactly too."""
    found = diagnose(ARM, session([drives.JointGain(at(2, 0.02))], n=6, seed=3))
    assert (found.fit.judged["sigma"] > SIGMA / 4).all()
    assert (found.fit.judged["sigma"] < SIGMA * 4).all()
