"""The robust joint fit: what was planted is recovered, and the stated uncertainty is true."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from read_arm import ARM as HEAVY
from scipy.stats import f
from small_arm import ARM as SMALL
from telescope_arm import WEIGHTLESS, heavy

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.calibrate import declared_model, fit_stages, geometry_terms
from longarm_comp.core.calibration.fit import CLOSE, fit_model, fit_together
from longarm_comp.core.calibration.noise import (
    NoiseEstimate,
    limit_by_repeats,
    noise_from_repeats,
)
from longarm_comp.core.calibration.placed_model import placement_terms
from longarm_comp.core.calibration.placement import place_bases
from longarm_comp.core.calibration.session_problem import SessionProblem
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance, LinkBending
from longarm_comp.core.effects.geometry_errors import DhError, JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.masses import UndeclaredWeight
from longarm_comp.core.effects.placements import BasePose, TipOffset
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.effects.slow_changes import ThermalGrowth
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model

SIGMA = 4e-4


def box(arm: Arm, n: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(arm.lower, arm.upper, (n, arm.n))


def empty(arm: Arm) -> Session:
    return Session.record(np.tile(arm.mid, (4, 1)), np.zeros((4, 3)))


def planted(arm: Arm, rng: np.random.Generator, elastic: bool = True) -> Model:
    """Sag, every geometry error drawn from its prior, and a compliance in every joint."""
    terms = (LinkDeflection(), *geometry_terms(arm, empty(arm)))
    model = Model(arm, (*terms, *(JointCompliance.for_arm(arm) if elastic else ())))
    drawn = []
    for slot in model.slots:
        p = slot.parameter
        bounded = p.lower == 0.0
        drawn.append(p.prior * (rng.uniform(0.5, 1.5) if bounded else rng.standard_normal()))
    return model.with_values(np.array(drawn))


def blank(model: Model) -> Model:
    """The same model before anything is known."""
    return model.with_values(0.0 * model.values)


def measured(
    truth: Model, q: np.ndarray, rng: np.random.Generator, sigma: float = SIGMA, **more: Any
) -> Session:
    session = Session.record(q, np.zeros((len(q), 3)), **more)
    xyz = truth.measured(q, session.context()) + sigma * rng.standard_normal((len(q), 3))
    return Session.record(q, xyz, **more)


def test_geometry_and_compliance_are_recovered_through_outliers(
    arm: Arm, rng: np.random.Generator
) -> None:
    truth = planted(arm, rng)
    session = measured(truth, box(arm, 150, rng), rng)
    bad = rng.choice(150, 3, replace=False)
    xyz = session.xyz.copy()
    xyz[bad] += 0.05 * rng.standard_normal((3, 3))
    found = fit_model(blank(truth), dataclasses.replace(session, xyz=xyz))
    assert found.converged
    assert set(found.outliers) == set(bad)
    np.testing.assert_allclose(found.sigma, SIGMA, rtol=0.25)
    q = box(arm, 100, rng)
    before = np.linalg.norm(blank(truth).tip(q) - truth.tip(q), axis=1).mean()
    after = np.linalg.norm(found.model.tip(q) - truth.tip(q), axis=1).mean()
    assert before > 0.02
    assert after < 0.8 * SIGMA  # off the data, and after 51 parameters
    for slot, got, want, se in zip(
        found.slots, found.model.values, truth.values, found.standard_errors, strict=True
    ):
        assert abs(got - want) < 4.5 * se, slot.label


def test_covariance_is_calibrated(arm: Arm) -> None:
    """Errors over stated standard errors, pooled over parameters and seeds: unit normal."""
    scores, tips = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = planted(arm, rng, elastic=False)
        found = fit_model(blank(truth), measured(truth, box(arm, 80, rng), rng))
        error = found.model.values - truth.values
        scores.append(error / found.standard_errors)
        g = found.columns.reshape(-1, len(error))
        spread = np.sqrt(np.einsum("ij,jk,ik->i", g, found.covariance, g))
        tips.append((g @ error) / spread)
    z = np.concatenate(scores)
    assert 0.85 < z.std() < 1.15
    assert 0.9 < (np.abs(z) < 1.96).mean() <= 1.0
    assert 0.85 < np.concatenate(tips).std() < 1.15  # and so of what they predict


def test_several_base_placements(arm: Arm, rng: np.random.Generator) -> None:
    group = np.repeat(["a", "b"], 40)
    bases = (BasePose("a", x=0.02, rz=0.03), BasePose("b", y=-0.04, rx=-0.02))
    truth = Model(arm, (LinkDeflection(), *bases, JointZero(2, offset=5e-3)))
    session = measured(truth, box(arm, 80, rng), rng, sigma=1e-4, labels={"group": group})
    assert [f.group for f in placement_terms(arm, session) if isinstance(f, BasePose)] == ["a", "b"]
    model = Model(arm, (LinkDeflection(), *placement_terms(arm, session), *JointZero.for_arm(arm)))
    found = fit_model(model, session)
    q = box(arm, 30, rng)
    for name in ("a", "b"):
        there = Session.record(q, np.zeros((30, 3)), labels={"group": np.full(30, name)}).context()
        apart = found.model.measured(q, there) - truth.measured(q, there)
        assert np.linalg.norm(apart, axis=1).max() < 2e-4
    unknown = Session.record(q, np.zeros((30, 3)), labels={"group": np.full(30, "c")}).context()
    np.testing.assert_allclose(  # a placement that nobody has seen stays as declared
        found.model.measured(q, unknown)[:, 2],
        Model(arm, tuple(e for e in found.model.effects if not isinstance(e, BasePose))).tip(q)[
            :, 2
        ],
        atol=1e-12,
    )


def test_several_markers(rng: np.random.Generator) -> None:
    data = SMALL.model_dump(mode="json", exclude_none=True)
    data["markers"] = {
        "tip": {"frame": 4, "position_m": [0, 0.02, 0.05]},
        "elbow": {"frame": 3, "position_m": [0.03, 0, 0]},
    }
    arm = Arm.parse(data, "test")
    truth = Model(arm, (TipOffset("tip", x=2e-3, z=-1e-3), TipOffset("elbow", y=3e-3)))
    marker = np.where(rng.random(60) < 0.5, "tip", "elbow")
    session = measured(truth, box(arm, 60, rng), rng, sigma=2e-5, labels={"marker": marker})
    found = fit_model(Model(arm, TipOffset.for_arm(arm)), session)
    got = {t.marker: (t.x, t.y, t.z) for t in found.model.effects if isinstance(t, TipOffset)}
    np.testing.assert_allclose(got["tip"], (2e-3, 0, -1e-3), atol=2e-5)
    np.testing.assert_allclose(got["elbow"], (0, 3e-3, 0), atol=2e-5)


def test_stiffness_is_never_negative(arm: Arm, rng: np.random.Generator) -> None:
    """Data that ask for a joint that bends against its load get a stiff one."""
    against = JointCompliance(2, compliance=-2e-3)
    truth = Model(arm, (LinkDeflection(), against, JointCompliance(5, compliance=6e-3)))
    session = measured(truth, box(arm, 60, rng), rng)
    terms = (LinkDeflection(), *JointZero.for_arm(arm), *JointCompliance.for_arm(arm))
    found = fit_model(Model(arm, terms), session)
    values = {t.joint: t.compliance for t in found.model.effects if isinstance(t, JointCompliance)}
    assert values[2] == 0.0
    assert min(values.values()) == 0.0
    assert values[5] == pytest.approx(6e-3, rel=0.2)


def test_a_base_that_stands_elsewhere_is_found(arm: Arm, rng: np.random.Generator) -> None:
    """A tracker two metres off, turned by 90 degrees and more."""
    for turn in (math.pi / 2, -2.8):
        base = BasePose(x=2.0, y=-1.5, z=0.4, rx=0.1, rz=turn)
        truth = Model(arm, (LinkDeflection(), base))
        session = measured(truth, box(arm, 40, rng), rng)
        start = place_bases(Model(arm, (LinkDeflection(), *placement_terms(arm, session))), session)
        left = np.linalg.norm(start.tip(session.q) - session.xyz, axis=1)
        assert np.median(left) < 0.05  # sag in the wrong direction of gravity is not seen here
        found = fit_model(start, session)
        q = box(arm, 30, rng)
        apart = np.linalg.norm(found.model.tip(q) - truth.tip(q), axis=1)
        assert apart.max() < 1e-3
        near = measured(Model(arm, (LinkDeflection(),)), session.q, rng)
        kept = Model(arm, (LinkDeflection(), BasePose()))
        assert place_bases(kept, near) == kept  # a base that is right stays


def test_arms_on_one_torso_share_it(rng: np.random.Generator) -> None:
    """Two sessions, one chain; the marker is each arm's own."""
    parts, model = [], Model(SMALL, (*JointZero.for_arm(SMALL), TipOffset()))
    for offset in (2e-3, -3e-3):
        truth = Model(SMALL, (JointZero(1, offset=6e-3), JointZero(4, -4e-3), TipOffset(x=offset)))
        parts.append((model, measured(truth, box(SMALL, 30, rng), rng)))
    made = fit_together(parts, own=lambda slot: slot.owner.name == "tip_offset")
    left, right = (dict(zip([s.label for s in f.slots], f.model.values, strict=True)) for f in made)
    shared = [name for name in left if name.startswith("joint_zero")]
    assert len(shared) == 4
    assert all(left[name] == right[name] for name in shared)
    assert left["joint_zero / joint 1 / offset"] == pytest.approx(6e-3, abs=5e-4)
    assert left["tip_offset / tip / x"] - right["tip_offset / tip / x"] == pytest.approx(
        5e-3, abs=6e-4
    )
    alone = fit_model(*parts[0])
    assert made[0].standard_errors[0] < 0.85 * alone.standard_errors[0]


@pytest.mark.parametrize(("share", "close"), [(0.5, CLOSE), (0.9, 0.3)])
def test_loads_and_what_yields_are_fitted_to_the_end_wherever_it_starts(
    share: float, close: float
) -> None:
    """Rows tell little but their product: a step far within a standard error bends the design."""
    rng = np.random.default_rng(0)
    session = measured(heavy(1e6, 1e-5), box(WEIGHTLESS, 200, rng), rng)
    *_, (_, rigid) = fit_stages(declared_model(WEIGHTLESS), session)
    yielding = JointCompliance(1), LinkBending(2), UndeclaredWeight()
    known: dict[str, Any] = {"sigma": np.full(3, SIGMA), "weights": np.ones(200)}
    end = fit_model(rigid.model.plus(*yielding), session, **known)
    loads = np.array([s.owner.name == "undeclared_weight" for s in end.slots])
    soft = np.array([s.owner.elastic for s in end.slots])
    there = end.model.values * np.where(loads, 1.0 / share, np.where(soft, share, 1.0))
    again = fit_model(end.model.with_values(there), session, close=close, **known)
    assert again.converged
    cost = [(f.residual**2).sum() / SIGMA**2 for f in (end, again)]
    assert abs(cost[1] - cost[0]) < 2.0
    assert np.allclose(end.columns, end.model.columns(end.posture)[1], rtol=1e-9, atol=1e-12)


def test_a_step_that_runs_away_is_no_number(rng: np.random.Generator) -> None:
    """Its residual was finite, and the square of it was not."""
    q = rng.uniform(SMALL.lower, SMALL.upper, (20, SMALL.n))
    rows = Session.record(q, Model(SMALL).tip(q))
    part = SessionProblem(Model(SMALL, (TipOffset(),)), rows, sigma=np.full(3, 1e-4))
    part.move_to(np.full(3, 1e3), close=False)
    assert part.compute_cost() > 1e15
    with pytest.raises(JobError, match="did not stay finite"):
        part.move_to(np.full(3, 1e155), close=False)


def test_missing_inputs_are_named(arm: Arm, rng: np.random.Generator) -> None:
    session = measured(Model(arm), box(arm, 10, rng), rng)
    with pytest.raises(InputError, match=r"thermal_growth: temperature_c: 'missing'"):
        fit_model(Model(arm, (ThermalGrowth(),)), session)
    still = dataclasses.replace(session, approach=np.zeros_like(session.approach))
    with pytest.raises(InputError, match=r"backlash: approach: 'missing'"):
        fit_model(Model(arm, (Backlash(joint=1),)), still)
    lost = session.xyz.copy()
    lost[3:] = np.nan
    with pytest.raises(InputError, match="at least 4"):
        fit_model(Model(arm, (JointZero(1),)), dataclasses.replace(session, xyz=lost))


def test_noise_of_repeats_leaves_out_the_side(rng: np.random.Generator) -> None:
    """Eight poses, each from two sides three times; the sides differ by 2 mm, noise is 0.1 mm."""
    q = np.repeat(box(SMALL, 8, rng), 6, axis=0)
    side = np.tile([1, 1, 1, -1, -1, -1], 8)
    xyz = Model(SMALL).tip(q) + 1e-3 * side[:, None] + 1e-4 * rng.standard_normal((48, 3))
    xyz[7] += 0.03
    noise = noise_from_repeats(Model(SMALL), Session.record(q, xyz, approach=side))
    assert noise is not None
    assert noise.sigma == pytest.approx(1e-4, rel=0.35)
    assert (
        noise_from_repeats(Model(SMALL), Session.record(q[:6], xyz[:6], approach=side[:6])) is None
    )  # too few


def test_noise_is_no_more_than_the_repeats_allow_at_one_in_a_thousand() -> None:
    """18 repeats that scatter half as much by chance do not halve the noise."""
    repeats = NoiseEstimate(np.array([0.6, 0.45, 0.1, 2.0, 0.45]), "repeats", 0.0, 18.0)
    residual = NoiseEstimate(np.ones(5), "residual", 0.2, 270.0)
    found = limit_by_repeats(repeats, residual)
    most = repeats.sigma / np.sqrt(f.ppf(1e-3, 18, 270))
    np.testing.assert_allclose(found.sigma, [1.0, most[1], most[2], 1.0, most[4]], rtol=1e-6)
    assert 0.8 < most[1] < 0.95
    assert (found.source, found.rho, found.degrees) == ("repeats", 0.2, 270.0)
    sure = limit_by_repeats(dataclasses.replace(repeats, degrees=1000.0), residual)
    assert sure.sigma[1] == pytest.approx(0.45, rel=0.2)


def test_rows_count_by_the_noise_that_they_state_where_that_is_true(
    rng: np.random.Generator,
) -> None:
    """One row in four is ten times noisier than the others, as it says: none is an outlier."""
    n = 160
    rough = np.where(rng.random(n) < 0.25, 10.0, 1.0)
    truth = blank(Model(SMALL, (JointZero(1), JointZero(2)))).with_values(np.array([3e-3, -2e-3]))
    q = box(SMALL, n, rng)
    noise = 1e-4 * rough[:, None] * rng.standard_normal((n, 3))
    stated = np.repeat(3.0 * 1e-4 * rough[:, None], 3, axis=1)  # three times too careful
    rows = Session.record(q, truth.tip(q) + noise, sigma=stated)
    found = fit_model(blank(truth), rows)
    assert not len(found.outliers)
    np.testing.assert_allclose(found.weights, rough**-2.0)
    np.testing.assert_allclose(found.sigma, 1e-4, rtol=0.15)
    np.testing.assert_allclose(found.stated_noise_ratio(rows.take(rough > 1)), 10.0)
    chi2 = (((found.model.values - truth.values) / found.standard_errors) ** 2).sum()
    assert chi2 < 14.0
    alike = fit_model(blank(truth), dataclasses.replace(rows, sigma=None))
    assert len(alike.outliers) > 20
    assert (found.standard_errors < 0.9 * alike.standard_errors).all()


def test_stated_noise_that_the_rows_do_not_show_counts_for_nothing(
    rng: np.random.Generator,
) -> None:
    n = 160
    truth = blank(Model(SMALL, (JointZero(1), JointZero(2)))).with_values(np.array([3e-3, -2e-3]))
    q = box(SMALL, n, rng)
    stated = np.repeat(10.0 ** rng.uniform(-5, -4, (n, 1)), 3, axis=1)
    rows = Session.record(q, truth.tip(q) + 1e-4 * rng.standard_normal((n, 3)), sigma=stated)
    found = fit_model(blank(truth), rows)
    assert set(found.weights) <= {0.0, 1.0}
    assert (found.stated_noise_ratio(rows) == 1.0).all()


def test_a_link_laid_along_y_has_its_length_recovered(rng: np.random.Generator) -> None:
    rows = [
        {"id": 1, "type": "revolute", "d_m": 0.2, "limits_deg": [-90, 90]},
        {"id": 2, "type": "fixed", "pose": {"xyz_m": [0.0, 0.4, 0.0]}},
        {"id": 3, "type": "revolute", "limits_deg": [-90, 90]},
        {"id": 4, "type": "fixed", "pose": {"xyz_m": [0.0, 0.3, 0.0], "rpy_deg": [90, 0, 0]}},
        {"id": 5, "type": "revolute", "limits_deg": [-90, 90]},
    ]
    tip = {"frame": 5, "position_m": [0.1, 0.0, 0.05]}
    arm = Arm.parse({"name": "y", "convention": "mdh_craig", "tip": tip, "joints": rows}, "y")
    true = Model(arm, (DhError(row=3, b=1e-3),))
    q = rng.uniform(arm.lower, arm.upper, (200, arm.n))
    seen = true.tip(q) + 2e-5 * rng.standard_normal((200, 3))
    found = fit_model(Model(arm, geometry_terms(arm, empty(arm))), Session.record(q, seen)).model
    asked = rng.uniform(arm.lower, arm.upper, (50, arm.n))
    assert np.abs(found.tip(asked) - true.tip(asked)).max() < 5e-5
    along = {e.row: e.b for e in found.effects if isinstance(e, DhError)}
    assert along[2] + along[3] == pytest.approx(1e-3, abs=2e-5)


def test_what_a_solver_rounds_beyond_a_bound_is_no_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such a file could not be read."""
    exact = linear.solve_products

    def rounded(*problem: Any) -> Any:
        found = exact(*problem)
        return dataclasses.replace(found, u=found.u - 1e-17 * (found.u == 0.0))

    model = declared_model(HEAVY).plus(JointCompliance.for_arm(HEAVY)[1])
    q = np.random.default_rng(1).uniform(HEAVY.lower, HEAVY.upper, (20, HEAVY.n))
    lifted = model.with_values(np.array([-1e-3])).tip(q)  # against its load
    monkeypatch.setattr(linear, "solve_products", rounded)
    assert fit_model(model, Session.record(q, lifted)).model.values[0] == 0.0
