"""DH rows of nearly parallel axes, hundreds of metres long: the same promise for the same arm."""

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.effects.geometry_errors import DhError
from longarm_comp.core.model.model import Model


def arm(*second_and_third: dict[str, float]) -> Arm:
    """A six-joint arm of a metre, its second and third row as given."""
    rows: list[dict[str, float]] = [
        {"d_m": 0.18},
        *second_and_third,
        {"a_m": -0.57, "d_m": 0.17},
        {"alpha_deg": 90, "d_m": 0.12},
        {"alpha_deg": -90, "d_m": 0.12},
    ]
    every = {"type": "revolute", "limits_deg": [-180, 180]}
    joints = [{"id": k, **every, **row} for k, row in enumerate(rows, 1)]
    given = {"name": "a", "convention": "mdh_craig", "tip": {"frame": 6}, "joints": joints}
    return Arm.parse(given, "a")


SHORT = arm(
    {"alpha_deg": 90, "theta_offset_deg": 90}, {"a_m": 0.5585, "theta_offset_deg": -90}
)  # fmt: skip
LONG = arm(
    {"alpha_deg": 90, "theta_offset_deg": 90, "d_m": 400.0},
    {"alpha_deg": 0.08, "theta_offset_deg": -90, "d_m": -400.0},
)
TURNED = np.array([0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0])
"""Of the joints of the one against the other."""


@pytest.mark.parametrize("seed", range(4))
def test_the_promise_does_not_depend_on_how_rows_are_written(seed: int) -> None:
    """Not by 4 mrad at a lever of 400 m; zeros set by hand move the tip by centimetres."""
    q = np.random.default_rng(seed).uniform(-2.5, 2.5, 6)
    promised = []
    for a, joints in ((SHORT, q), (LONG, q + TURNED)):
        miss = expected_miss(Model(a), joints, Context(), Model(a).tip(joints[None])[0])
        promised.append(1e3 * float(miss.sizes[0]))
    assert 5.0 < promised[0] < 40.0
    assert promised[1] == pytest.approx(promised[0], rel=0.05)


def test_a_tilt_turns_about_a_place_on_the_arm() -> None:
    """Whatever else it does, it turns the arm by as much."""
    q = np.zeros((1, 6))
    for name in ("alpha", "beta"):
        tilted = Model(LONG, (DhError(3, **{name: 1e-3}),))
        moved = tilted.pose(q)[0] - Model(LONG).pose(q)[0]
        assert np.linalg.norm(moved[:3, 3]) < 1.5e-3
        assert np.linalg.norm(moved[:3, :3]) == pytest.approx(np.sqrt(2) * 1e-3, rel=1e-3)


def test_rows_of_an_ordinary_arm_tilt_about_their_origin() -> None:
    assert Model(SHORT).chain.tilted_at == (0.0,) * 6
    assert np.count_nonzero(Model(LONG).chain.tilted_at) == 1
