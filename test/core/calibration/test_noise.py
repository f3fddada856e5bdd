"""The noise as a rich fit leaves it: no axis may be fitted exactly."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from few_effects import FEW
from hidden_arm import SIGMA, at, calibrated, session
from small_arm import ARM

from longarm_comp.core.calibration.noise import (
    _share_by_groups,
    _share_by_joints,
    noise_from_residual,
    share_of_sensor,
)
from longarm_comp.core.calibration.uncertainty import measure_uncertainty
from longarm_comp.core.data.measured_rows import ChannelBlock
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.structure import SIGNIFICANT
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.uncertainty import sizes
from longarm_comp.sim.hidden import drives

NOISE = 2e-5
"""m, of every axis."""
ROWS, COLUMNS = 40, 200


def fit_of(residual: np.ndarray) -> Any:
    """A fit of nothing, which leaves so much (N, 3)."""
    rows = len(residual)
    session = SimpleNamespace(
        measured=np.ones((rows, 3), dtype=bool),
        claimed_sigma={},
        uneven=lambda _: np.ones(rows),
        blocks=(ChannelBlock("position"),),
        channels=("x", "y", "z"),
    )
    return SimpleNamespace(
        columns=np.zeros((rows, 3, 0)),
        slots=(),
        residual=residual,
        weights=np.ones(rows),
        has_point=np.zeros(rows, dtype=bool),
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
    noise, weights = noise_from_residual(fit_of(seen), extra.reshape(ROWS, 3, COLUMNS))
    assert (noise.sigma > NOISE / 3).all()
    assert (noise.sigma < NOISE * 2).all()
    assert (weights == 1.0).all()


def test_every_axis_counts_its_own_freedom() -> None:
    """A depth three times as noisy as the rest, and a library that moves x alone."""
    true, rng = np.array([1.0, 3.0, 1.0]) * NOISE, np.random.default_rng(0)
    extra = np.zeros((200, 3, 120))
    extra[:, 0] = 1e-2 * rng.standard_normal((200, 120))
    noise, _ = noise_from_residual(fit_of(true * rng.standard_normal((200, 3))), extra)
    assert noise.sigma == pytest.approx(true, rel=0.15)


@pytest.mark.usefixtures("few_names")
def test_six_poses_that_can_be_fitted_exactly_keep_a_noise() -> None:
    """By a noise of nothing no prior would count, and rows held out would be met exactly too."""
    found = diagnose(ARM, session([drives.JointGain(at(2, 0.02))], n=6, seed=3), kinds=FEW)
    assert (found.fit.noise_arguments["sigma"] > SIGMA / 4).all()
    assert (found.fit.noise_arguments["sigma"] < SIGMA * 4).all()


@pytest.mark.parametrize(
    ("times", "share", "whole"),
    [(0.2, 1.0, 1.0), (1.0, 0.96, 0.9), (3.0, 0.6, 0.6), (10.0, 0.04, 0.02), (100.0, 3e-4, 0.0)],
)
def test_noise_is_the_sensors_as_far_as_it_may_have_stated_it(
    times: float, share: float, whole: float
) -> None:
    """The rows scatter so many times as much as they state."""
    fit = fit_of(np.zeros((ROWS, 3)))
    fit.session.claimed_sigma = dict.fromkeys(fit.session.channels[:2], 1e-3 / times)
    found = share_of_sensor(fit)
    assert found[:2] == (pytest.approx(share, 0.3), pytest.approx(whole, abs=0.1))
    fit.session.claimed_sigma = {}
    assert share_of_sensor(fit)[:2] == (1.0, 1.0)


@pytest.mark.usefixtures("few_names")
@pytest.mark.parametrize("stated", [np.full((80, 3), SIGMA), None], ids=["stated", "unstated"])
def test_two_tools_that_nobody_wrote_down_are_no_sensors_noise(stated: np.ndarray | None) -> None:
    """Half of the rows were touched with a tool 20 mm longer: each command misses by ten."""
    rows = session(n=80)
    turned = Model(ARM).pose(rows.q, rows.context())[:, :3, 0]
    longer = np.random.default_rng(0).choice([0.0, 0.02], 80)[:, None] * turned
    found = diagnose(ARM, dataclasses.replace(rows, xyz=rows.xyz + longer, sigma=stated))
    assert found.verdict == "unknown"
    promised = sizes(measure_uncertainty(found.fit).structure)[1]
    assert 0.01 < promised < 0.03


@pytest.mark.usefixtures("few_names")
def test_rows_about_two_middles_are_no_sensors_noise() -> None:
    """Every third row is 20 mm off along z, in no order and with no cause that any input tells."""
    rows = session(n=80)
    off = np.zeros((80, 3))
    off[np.random.default_rng(0).permutation(80) < 27, 2] = 0.02
    found = diagnose(ARM, dataclasses.replace(rows, xyz=rows.xyz + off))
    assert found.verdict == "unknown"
    assert found.structure.sign.startswith("has two middles, 20")
    promised = sizes(measure_uncertainty(found.fit).structure)[1]
    assert 0.01 < promised < 0.03


def test_joints_that_do_not_come_back_are_no_sensors_noise() -> None:
    """Each scatters by 3 mrad, a slide by 0.75 mm: the tip the more, the farther it is out."""
    unit = np.where(ARM.slides, 0.75e-3, 3e-3)
    for seed in range(4):
        rows = session(n=80, seed=seed)
        turned = rows.q + unit * np.random.default_rng(seed).standard_normal(rows.q.shape)
        off = Model(ARM).tip(turned) - Model(ARM).tip(rows.q)
        found = share_of_sensor(calibrated(dataclasses.replace(rows, xyz=rows.xyz + off)))
        assert found.share < 0.3 and found.whole < 0.05
        assert found.sign.startswith("grows with the joints' levers")


@pytest.mark.parametrize("kind", ["normal", "uniform", "wave", "tails", "coarse", "depth"])
def test_noise_about_one_middle_is_the_sensors(kind: str) -> None:
    rng = np.random.default_rng(1)
    for count in (30, 100, 1000):
        normal = rng.standard_normal((count, 3))
        noise = {
            "normal": normal,
            "uniform": rng.uniform(-1.0, 1.0, (count, 3)),
            "wave": normal * [0.1, 0.1, 0.0] + np.outer(np.sin(np.arange(count)), [0.0, 0.0, 1.0]),
            "tails": np.clip(rng.standard_cauchy((count, 3)), -4.0, 4.0),
            "coarse": np.round(0.8 * normal),
            "depth": normal * [1.0, 1.0, 30.0],
        }[kind]
        assert _share_by_groups(1e-4 * noise).share > 0.99
    few = [_share_by_groups(rng.standard_normal((12, 3))).whole for _ in range(40)]
    assert np.mean(few) > 0.9


def test_an_arm_that_does_not_come_back_is_no_ones_first_thought() -> None:
    """One session in twenty, before its rows: even noise is the sensor's."""
    rng = np.random.default_rng(1)
    draws = [rng.standard_normal((2, 12, 3, 5)) for _ in range(60)]
    few = [_share_by_joints(noise[:, :, 0], columns).whole for noise, columns in draws]
    assert np.mean(few) > 0.98


@pytest.mark.parametrize("uneven", [(1.0, 1.0, 1.0), (1.0, 1.0, 8.0)], ids=["even", "depth"])
def test_a_sensors_noise_does_not_turn_with_the_tool(uneven: tuple[float, ...]) -> None:
    """Nor does that of a camera that sees depth badly: all of it is the sensor's."""
    wholes = []
    for seed in range(8):
        noise = lambda rng, n: SIGMA * np.array(uneven) * rng.standard_normal((n, 3))  # noqa: E731
        found = share_of_sensor(calibrated(session(n=80, seed=seed, noise=noise)))
        assert found.share > 0.9
        wholes.append(found.whole)
    assert min(wholes) > SIGNIFICANT and np.mean(wholes) > 0.7


@pytest.mark.usefixtures("few_names")
@pytest.mark.parametrize(("stated", "verdict"), [(SIGMA, "unknown"), (5 * SIGMA, "noise")])
def test_scatter_far_beyond_what_the_rows_state_is_not_called_noise(
    stated: float, verdict: str
) -> None:
    rows = session(n=80, noise=lambda rng, n: 15 * SIGMA * rng.standard_normal((n, 3)))
    found = diagnose(ARM, dataclasses.replace(rows, sigma=np.full((80, 3), stated)))
    assert found.verdict == verdict
