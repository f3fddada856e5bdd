"""A recorded column that moves the error is found, on whatever axis, and never called noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hidden_arm import SIGMA as HIDDEN_SIGMA
from hidden_arm import session
from small_arm import ARM

from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.drivers import drivers

N = 140
SIGMA = 3e-4


def columns(rng: np.random.Generator) -> dict[str, np.ndarray]:
    warm = 20.0 + np.linspace(0.0, 8.0, N) + 0.1 * rng.standard_normal(N)
    return {"pump_bar": rng.uniform(1.0, 3.0, N), "temperature_c": warm, "t_s": 16.0 * np.arange(N)}


def test_a_wave_is_found_on_its_axis_with_its_rate(rng: np.random.Generator) -> None:
    held, residual = columns(rng), SIGMA * rng.standard_normal((N, 3))
    residual[:, 0] += 4e-3 * np.sin(6.0 * held["pump_bar"])
    (found,) = drivers(residual, held)
    assert (found.column, found.axes) == ("pump_bar", (0,))
    assert float(found.shape.removeprefix("sin(").split()[0]) == pytest.approx(6.0, abs=0.1)
    assert found.share > 0.95
    left = residual - found.part
    np.testing.assert_allclose(left.std(axis=0), SIGMA, rtol=0.25)


def test_lines_and_curves_are_told_from_waves(rng: np.random.Generator) -> None:
    held, noise = columns(rng), SIGMA * rng.standard_normal((N, 3))
    pump = held["pump_bar"] - 2.0
    line, curve = noise.copy(), noise.copy()
    line[:, 1] += 4e-4 * pump
    curve[:, 1:] += np.outer(pump**2, [8e-4, 12e-4])
    assert [(d.shape, d.axes) for d in drivers(line, held)] == [("pump_bar", (1,))]
    assert [(d.shape, d.axes) for d in drivers(curve, held)] == [("curve of pump_bar", (2, 1))]


def test_two_drivers_are_found_one_after_the_other(rng: np.random.Generator) -> None:
    held, residual = columns(rng), SIGMA * rng.standard_normal((N, 3))
    held["fan_rpm"] = rng.integers(0, 5, N) * 500.0
    residual[:, 0] += 1e-3 * held["pump_bar"]
    residual[:, 2] += 5e-7 * held["fan_rpm"]
    assert {d.column: d.axes for d in drivers(residual, held)} == {
        "pump_bar": (0,),
        "fan_rpm": (2,),
    }


def test_what_the_joints_explain_drives_nothing(rng: np.random.Generator) -> None:
    joint = rng.uniform(-1.0, 1.0, N)
    held = {"incl": joint + 0.05 * rng.standard_normal(N)}
    residual = np.outer(joint, [0.0, 1e-3, 0.0]) + SIGMA * rng.standard_normal((N, 3))
    assert [d.column for d in drivers(residual, held)] == ["incl"]
    assert drivers(residual, held, beside=joint[:, None]) == []


def test_noise_has_no_driver_even_where_it_is_correlated_in_time() -> None:
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(20):
        white = SIGMA * rng.standard_normal((N, 3))
        slow = white.copy()
        for k in range(1, N):
            slow[k] += 0.9 * slow[k - 1]
        found += len(drivers(white, columns(rng))) + len(drivers(slow, columns(rng)))
    assert found == 0


def test_an_effect_below_the_known_noise_is_none(rng: np.random.Generator) -> None:
    held, residual = columns(rng), 1e-5 * rng.standard_normal((N, 3))
    residual[:, 0] += 3e-5 * held["pump_bar"]
    assert drivers(residual, held)
    assert drivers(residual, held, np.full(3, 1e-3)) == []


def test_the_diagnosis_names_the_driver_and_not_the_noise(rng: np.random.Generator) -> None:
    """x += 4 mm sin(6 pump_bar) in 140 rows: 2.8 mm that were the noise of x."""
    rows = session(n=N)
    pump = rng.uniform(1.0, 3.0, N)
    xyz = rows.xyz + np.outer(4e-3 * np.sin(6.0 * pump), [1.0, 0.0, 0.0])
    driven = dataclasses.replace(rows, xyz=xyz, columns={**rows.columns, "pump_bar": pump})
    found = diagnose(ARM, driven, kinds=(JointGain,))
    assert found.verdict == "partly" and not found.findings
    (cause,) = found.causes
    assert cause.inputs == ("pump_bar",)
    assert abs(cause.amounts[0].value) == pytest.approx(4e-3, rel=0.02)
    assert any("camera" in place for place in cause.where)
    assert found.written == "with_functions"
    np.testing.assert_allclose(found.search.noise.sigma, HIDDEN_SIGMA, rtol=0.35)


def test_noise_that_is_far_larger_on_one_axis_is_noise_of_that_axis(
    rng: np.random.Generator,
) -> None:
    rows = session(n=N)
    uneven = dataclasses.replace(rows, xyz=rows.xyz + rng.normal(0.0, [8e-3, 0.0, 0.0], (N, 3)))
    found = diagnose(ARM, uneven, kinds=(JointGain,))
    assert (found.verdict, found.findings) == ("noise", ())
    assert found.search.noise.sigma[0] == pytest.approx(8e-3, rel=0.2)
    np.testing.assert_allclose(found.search.noise.sigma[1:], HIDDEN_SIGMA, rtol=0.35)
