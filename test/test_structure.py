"""What is left in the residual: structure that moves one axis only does not hide among three."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.polynomial.legendre import Legendre
from small_arm import ARM, measured

from longarm_comp.core.identify.calibrate import declared_model, stages
from longarm_comp.core.identify.discover.set_aside import SharedDisplacement
from longarm_comp.core.identify.minor import SMALLEST_M
from longarm_comp.core.identify.outcome import all_signs
from longarm_comp.core.identify.structure import Structure, examine
from longarm_comp.core.model.model import Model

SIGMA = 1e-4
"""Noise of `measured`, m."""
SIZE = 0.75 * SIGMA
"""RMS of the structure: along one axis certain, among three axes p is 0.007 to 0.02."""
AXIS = np.array([1.0, 0.0, 0.0])


def left(seed: int, size: float, noise: float = 1.0, least: float = 0.0) -> Structure:
    """Of 120 poses whose x is off by a function of the first joint, no geometry error's.

    Args:
        noise: in that of `measured`.
        least: as of `examine`.
    """
    rows = measured(120, np.random.default_rng(seed))
    tips = Model(ARM).tip(rows.q)
    rows = dataclasses.replace(rows, xyz=tips + noise * (rows.xyz - tips))
    share = (rows.q[:, 0] - ARM.lower[0]) / (ARM.upper[0] - ARM.lower[0])
    wave = Legendre.basis(5)(2.0 * share - 1.0)
    wave *= size / np.sqrt((wave**2).mean())
    off = dataclasses.replace(rows, xyz=rows.xyz + np.outer(wave, AXIS))
    *_, (_, fitted) = stages(declared_model(ARM), off)
    return examine(fitted, fitted, np.random.default_rng(0), least)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_what_moves_one_axis_shows_beside_the_noise_of_the_others(seed: int) -> None:
    found = left(seed, SIZE)
    assert found.flag
    assert found.inputs[0] == "q1"
    assert found.size_m == pytest.approx(SIZE, rel=0.6)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_noise_leaves_none(seed: int) -> None:
    assert not left(seed, 0.0).flag


@pytest.mark.parametrize(("size", "shows"), [(0.5, False), (2.0, True)])
def test_what_is_left_counts_from_a_size_on(size: float, shows: bool) -> None:
    """However small the noise: where nothing is named, that from which on something would be."""
    assert left(1, size * SMALLEST_M, noise=0.05).flag
    assert left(1, size * SMALLEST_M, noise=0.05, least=SMALLEST_M).flag is shows


@pytest.mark.parametrize(
    ("every", "of_noise", "alike", "shows"),
    [
        (5, 0.5, False, ""),
        (5, 3.0, False, "shows in the rows left out"),
        (20, 3.0, False, ""),
        (20, 3.0, True, "shows in rows left out: 5 of 100 share one displacement (0.46 mm)"),
        (20, 0.5, True, ""),
    ],
)
def test_rows_left_out_are_a_sign_only_where_they_matter_and_are_many_or_alike(
    every: int, of_noise: float, alike: bool, shows: str
) -> None:
    """Some rows are left out; their errors, over all rows, are a share of the noise."""
    weights = (np.arange(100) % every > 0).astype(float)
    sigma = np.full(3, 2e-5)
    length = of_noise * np.linalg.norm(sigma) * np.sqrt(every)
    residual = np.where(weights[:, None] > 0, 0.0, length / np.sqrt(3.0)) * np.ones(3)
    fit = SimpleNamespace(
        weights=weights, residual=residual, metres=np.ones(3), noise_m=sigma,
        session=SimpleNamespace(
            blocks=[SimpleNamespace(kind="position")], take=lambda _: [], located=True
        ),
    )  # fmt: skip
    noise = SimpleNamespace(unevenness=1.0, sigma=sigma)
    result: Any = SimpleNamespace(fit=fit, noise=noise, exhausted=False)
    proof: Any = SimpleNamespace(off=False, excess_m=0.0)
    nothing = Structure(False, 1.0, (), 0.0, 1.0, ())
    group = SharedDisplacement(weights == 0, length, 20.0)
    found = all_signs(nothing, result, proof, group if alike else None)
    assert (found.flag, found.sign) == (bool(shows), shows)
    assert found.inputs == (("outliers",) if shows else ())
