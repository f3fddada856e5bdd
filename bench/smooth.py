"""A smooth residual with a known truth, for benchmarks and tests of the learner.

Seven joints in the boxes of the paper's arm, a three-axis residual of several millimetres made of
joint compliance, joint zeros and gear eccentricity in closed form, and 0.4 mm of noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

Array = NDArray[np.float64]

LOWER = np.array([np.deg2rad(-15), 0.0, 0.0, 0.0, np.deg2rad(-45), np.deg2rad(-30), 0.0])
UPPER = np.array(
    [np.deg2rad(15), np.deg2rad(30), 0.105, np.deg2rad(60), 0.0, np.deg2rad(30), 0.063]
)
NOISE_M = 0.4e-3


@dataclass(frozen=True)
class SmoothSet:
    """Training samples with noise and noise-free test samples."""

    q: Array  # (N, 7) rad, m
    residual: Array  # (N, 3) m, with noise
    test_q: Array  # (T, 7)
    test_truth: Array  # (T, 3) m, noise-free
    test_residual: Array  # (T, 3) m, with noise


def smooth_residual(q: Array) -> Array:
    """Noise-free residual (N, 3) in m at joints (N, 7)."""
    yaw, pitch, boom, roll, wrist, swing, feed = q.T
    r, s = 0.52 + boom, 0.38 + feed
    dip = pitch + wrist * np.cos(roll)
    side = swing + wrist * np.sin(roll)
    reach = r * np.cos(pitch) + s * np.cos(dip) * np.cos(side)
    lift = r * np.sin(pitch) + s * np.sin(dip)
    droop = 0.011 * reach + 0.004 * np.sin(2 * pitch + 1.9)  # rad about the shoulder
    twist = 0.012 * s * np.sin(dip) + 0.006 * np.cos(2 * roll + 2.6)
    bend = 0.016 * s * np.cos(dip) + 0.005 * np.sin(2 * wrist - 0.8)
    turn = 0.007 * np.sin(2 * yaw + 0.4) + 0.01 * (side - 0.2 * roll)
    radial = -droop * lift - bend * s * np.sin(dip) * np.cos(roll)
    across = turn * reach + twist * s * np.sin(side) + bend * s * np.sin(roll)
    up = droop * reach - bend * s * np.cos(dip) * np.cos(roll) - twist * s * np.sin(side)
    x = radial * np.cos(yaw) - across * np.sin(yaw)
    y = radial * np.sin(yaw) + across * np.cos(yaw)
    return np.stack((x, y, up), axis=1)


def rms_mm(error: Array) -> float:
    """Root mean square of errors in m, of any shape, in mm."""
    return 1e3 * float(np.sqrt(np.mean(error**2)))


def smooth_set(samples: int, seed: int, test: int = 1000) -> SmoothSet:
    """Sobol training poses, uniform random test poses, noise on both; deterministic by ``seed``."""
    rng = np.random.default_rng(seed)
    sobol = qmc.Sobol(7, rng=rng).random_base2(int(np.ceil(np.log2(samples))))[:samples]
    q = LOWER + sobol * (UPPER - LOWER)
    test_q = rng.uniform(LOWER, UPPER, (test, 7))
    truth = smooth_residual(test_q)
    return SmoothSet(
        q=q,
        residual=smooth_residual(q) + NOISE_M * rng.standard_normal((samples, 3)),
        test_q=test_q,
        test_truth=truth,
        test_residual=truth + NOISE_M * rng.standard_normal((test, 3)),
    )
