"""The path of a trajectory: its peak velocity, its extremes, its slopes."""

import numpy as np
import pytest

from longarm_comp.devices.joint_path import plan_path


@pytest.mark.parametrize("seed", range(8))
def test_peak_velocity_and_extremes_agree_with_sampling(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.2, 1.0, 5))
    positions = rng.uniform(-1, 1, (5, 3))
    velocities = rng.normal(size=(5, 3)) if seed % 2 else None
    path = plan_path(rng.uniform(-1, 1, 3), times, positions, velocities, np.full(3, 0.7))
    dense = np.array([path.at(t) for t in np.linspace(0.0, path.duration, 4001)])
    low, high = path.extremes()
    assert low == pytest.approx(dense.min(axis=0), abs=1e-4)
    assert high == pytest.approx(dense.max(axis=0), abs=1e-4)
    speed = np.abs(np.diff(dense, axis=0)).max(axis=0) / (path.duration / 4000)
    assert path.peak_velocity() == pytest.approx(speed, rel=2e-3, abs=1e-6)
    assert path.peak_velocity().max() <= 0.7 * (1 + 1e-9)


def test_without_velocities_the_path_stays_between_its_way_points() -> None:
    rng = np.random.default_rng(3)
    times, start = np.cumsum(rng.uniform(0.3, 2.0, 40)), rng.uniform(-0.1, 0.1, 2)
    positions = rng.uniform(-0.1, 0.1, (40, 2)) ** 3
    path = plan_path(start, times, positions, None, np.full(2, 10.0))
    assert path.stretch == 1.0
    for k in range(len(path.times) - 1):
        inside = path.at(np.linspace(path.times[k], path.times[k + 1], 50))
        ends = path.joints[k : k + 2]
        assert (inside >= ends.min(axis=0) - 1e-12).all()
        assert (inside <= ends.max(axis=0) + 1e-12).all()
    assert path.velocities[[0, -1]] == pytest.approx(np.zeros((2, 2)))
