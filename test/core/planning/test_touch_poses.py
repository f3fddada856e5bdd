"""Plans of touches: which socket, from where."""

from pathlib import Path

import numpy as np
import pytest
from touching import ARM, SOCKETS

import longarm_comp as la
from longarm_comp.core.data.plan import Plan
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.planning.optimal_poses import Uncertainty, draw_touch_poses
from longarm_comp.sessions.poses import read_poses, write_poses


def test_a_plan_of_touches_says_which_socket_and_beats_chance(tmp_path: Path) -> None:
    """Of as many touches, those that are planned leave less than those that happened."""
    points = {name: tuple(map(float, place)) for name, place in SOCKETS.items()}
    known = declared_model(ARM)
    planned = la.plan(ARM, 18, kind="i-optimal", measure="touch", points=points, model=known)
    assert planned.touch is not None
    assert len(set(planned.touch)) >= 4
    at = np.array([points[name] for name in planned.touch])
    np.testing.assert_allclose(known.tip(planned.q), at, atol=1e-6)
    write_poses(planned, tmp_path / "poses.csv")
    again = read_poses(tmp_path / "poses.csv", ARM)
    np.testing.assert_array_equal(again.touch, planned.touch)

    def left(q: np.ndarray, names: np.ndarray) -> float:
        pool = Plan(q, np.ones(q.shape), None, names)
        uncertain = Uncertainty.of(known, None, "touch", known=True, sigma=(3e-4, 1e-3), pool=pool)
        x = uncertain.measures(pool, "touch").reshape(3 * len(q), -1)
        covariance = np.linalg.inv(uncertain.information + x.T @ x)
        return float(np.trace(uncertain.tips(everywhere) @ covariance))

    everywhere = np.random.default_rng(7).uniform(ARM.lower, ARM.upper, (100, ARM.n))
    pool = draw_touch_poses(known, points, 300, np.random.default_rng(1))
    assert pool.touch is not None
    chance = []
    for seed in range(5):
        drawn = np.random.default_rng(seed).permutation(len(pool))[:18]
        chance.append(left(pool.q[drawn], pool.touch[drawn]))
    assert left(planned.q, planned.touch) < 0.8 * np.median(chance)


def test_touches_that_cannot_be_planned() -> None:
    with pytest.raises(InputError, match="points: 'none'"):
        la.plan(ARM, 12, kind="i-optimal", measure="touch")
    with pytest.raises(InputError, match="point far: '9, 0, 0'"):
        la.plan(ARM, 12, kind="i-optimal", measure="touch", points={"far": (9.0, 0.0, 0.0)})
