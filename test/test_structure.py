"""What is left in the residual: structure that moves one axis only does not hide among three."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.polynomial.legendre import Legendre
from small_arm import ARM, measured

from longarm_comp.core.calibration.calibrate import declared_model, stages
from longarm_comp.core.identify.structure import Structure, examine

SIGMA = 1e-4
"""Noise of `measured`, m."""
SIZE = 0.75 * SIGMA
"""RMS of the structure: along one axis certain, among three axes p is 0.007 to 0.02."""
AXIS = np.array([1.0, 0.0, 0.0])


def left(seed: int, size: float) -> Structure:
    """Of 120 poses whose x is off by a function of the first joint, no geometry error's."""
    rows = measured(120, np.random.default_rng(seed))
    share = (rows.q[:, 0] - ARM.lower[0]) / (ARM.upper[0] - ARM.lower[0])
    wave = Legendre.basis(5)(2.0 * share - 1.0)
    wave *= size / np.sqrt((wave**2).mean())
    off = dataclasses.replace(rows, xyz=rows.xyz + np.outer(wave, AXIS))
    *_, (_, fitted) = stages(declared_model(ARM), off)
    return examine(fitted, fitted)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_what_moves_one_axis_shows_beside_the_noise_of_the_others(seed: int) -> None:
    found = left(seed, SIZE)
    assert found.flag
    assert found.inputs[0] == "q1"
    assert found.size_m == pytest.approx(SIZE, rel=0.6)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_noise_leaves_none(seed: int) -> None:
    assert not left(seed, 0.0).flag
