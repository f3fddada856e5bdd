"""The evidence search on small sessions: a planted effect is found, none is made up."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from demo_rows import N, session_of

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.base_compliance import BaseCompliance
from longarm_comp.core.effects.bearing_tilt import BearingTilt
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.gear_eccentricity import GearEccentricity
from longarm_comp.core.effects.joint_compliance import JointCompliance
from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.effects.joint_term import reach, typical_loads
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.link_stiffness import LinkStiffness
from longarm_comp.core.effects.thermal_growth import ThermalGrowth
from longarm_comp.core.identify.aliasing import findings
from longarm_comp.core.identify.calibrate import declared_model, geometry
from longarm_comp.core.identify.candidates import Candidate, library
from longarm_comp.core.identify.evidence import FitMarginal, columns_at, score
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.search import SearchResult, search
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import loads
from studies.real_sessions import declared

KINDS = (JointCompliance, JointGain, GearEccentricity, ThermalGrowth)


@pytest.fixture(scope="module")
def arm(demo_arm_path: Path) -> Arm:
    return Arm.load(demo_arm_path)


def searched(arm: Arm, session: Session) -> SearchResult:
    base = Model(arm, (LinkDeflection(), *geometry(arm, session)))
    candidates = library(arm, session.context(), KINDS, base.terms)
    assert [name for name, _ in candidates.not_testable] == ["thermal_growth"]  # no temperature
    return search(base, session, candidates.testable)


def test_a_planted_compliance_is_named_with_its_value(arm: Arm) -> None:
    result = searched(arm, session_of(arm, 1, JointCompliance(2, compliance=8e-3)))
    assert [(t.name, t.where) for t in result.chosen] == [("joint_compliance", "joint 2")]
    found = [t for t in result.fit.model.effects if isinstance(t, JointCompliance)]
    assert found[0].compliance == pytest.approx(8e-3, rel=0.25)
    assert result.first[0].candidate.name == "joint_compliance"
    assert result.last[0].log_bayes_factor < result.threshold


def test_the_place_follows_the_effect(arm: Arm) -> None:
    result = searched(arm, session_of(arm, 2, JointGain(5, gain=0.04)))
    assert [(t.name, t.where) for t in result.chosen] == [("joint_gain", "joint 5")]


@pytest.mark.parametrize("scale", [0.2, 1.0, 30.0])
def test_evidence_counts_the_bounds_of_a_parameter(arm: Arm, scale: float) -> None:
    """Against the integral over the possible values: a beam cannot be ten times stiffer."""
    truth = dataclasses.replace(Model(arm), effects=())
    fitted = fit(Model(arm, (LinkDeflection(),)), session_of(arm, 7), sigma=np.full(3, 4e-4))
    rigid = scale * (truth.tip(fitted.session.q) - fitted.model.tip(fitted.session.q))
    softer = Candidate("link_stiffness", (LinkStiffness(beam=arm.links[-1].name),))
    columns = columns_at(fitted)
    marginal = FitMarginal(fitted, data=fitted.data + fitted.whitened(rigid[..., None])[:, 0])
    white = fitted.whitened(columns.of(softer.terms))[:, 0]
    u = np.linspace(-0.9 / 0.5, 8.0, 400_001)
    s, t = white @ marginal.project(white), white @ marginal.py
    log = u * t - 0.5 * u * u * (1.0 + s)
    whole = np.trapezoid(np.exp(log - log.max()), u) / np.trapezoid(np.exp(-0.5 * u * u), u)
    found = score(fitted, marginal, softer, columns)
    assert found.log_bayes_factor == pytest.approx(np.log(whole) + log.max(), abs=0.02)
    assert found.mean[0] >= -0.9


@pytest.mark.parametrize("seed", [3, 4])
def test_geometry_and_noise_alone_name_nothing(arm: Arm, seed: int) -> None:
    result = searched(arm, session_of(arm, seed))
    assert result.chosen == ()
    assert result.noise.sigma == pytest.approx(4e-4, rel=0.3)


def test_correlated_noise_is_no_effect_and_reaches_the_fit(arm: Arm) -> None:
    session = session_of(arm, 5)
    rng = np.random.default_rng(6)
    drift = np.zeros((N, 3))
    for k in range(1, N):
        drift[k] = 0.9 * drift[k - 1] + 3e-4 * rng.standard_normal(3)
    result = searched(arm, Session.record(session.q, session.xyz + drift))
    assert result.chosen == ()
    assert result.noise.rho > 0.3
    assert result.fit.rho == result.noise.rho


# ------------------------------------------------------------------ one name, or a set


def named(arm: Arm, session: Session, *kinds: type[Effect]) -> list[tuple[str, ...]]:
    base = Model(arm, (LinkDeflection(), *geometry(arm, session)))
    candidates = library(arm, session.context(), kinds, base.terms).testable
    return [f.names for f in findings(search(base, session, candidates), candidates)[1]]


def test_a_rival_is_compared_without_its_idle_places(arm: Arm) -> None:
    """Seven bearings would be worse than soft beams by 4.6; the two that matter are as good."""
    soft = [LinkStiffness(beam=beam.name, softness=0.5) for beam in arm.links[1:]]
    found = named(arm, session_of(arm, 16, *soft), LinkStiffness, BearingTilt, JointCompliance)
    assert found == [("link_stiffness", "bearing_tilt")]


ELASTIC = (BaseCompliance, BearingTilt, JointCompliance, LinkStiffness)


def test_a_soft_base_and_the_bearing_above_it_are_a_set(arm: Arm) -> None:
    """A column 10 times softer would do as well, and nobody believes it."""
    soft = BaseCompliance(about_x=2e-3, about_y=2e-3)
    found = named(arm, session_of(arm, 1, soft), *ELASTIC)
    assert [set(names) for names in found] == [{"base_compliance", "bearing_tilt"}]


def test_poses_tell_a_soft_base_from_a_bearing_that_turns(arm: Arm) -> None:
    tilting = BearingTilt(2, about_x=6e-3, about_y=6e-3)
    assert named(arm, session_of(arm, 1, tilting), *ELASTIC) == [("bearing_tilt",)]


HEAVY_BASE = Arm.parse(
    {
        "name": "printed",
        "convention": "mdh_craig",
        "tip": {"frame": 3, "position_m": [0.12, 0.0, 0.0]},
        "joints": [
            {"id": 1, "type": "revolute", "d_m": 0.09, "limits_deg": [-60, 60]},
            {
                "id": 2, "type": "revolute", "alpha_deg": 90, "theta_offset_deg": 60,
                "limits_deg": [-30, 30],
            },
            {
                "id": 3, "type": "revolute", "a_m": 0.16, "theta_offset_deg": -70,
                "limits_deg": [-40, 40],
            },
        ],
        "links": [
            {
                "name": "tube", "row": 3, "role": "a", "length_m": 0.16, "mass_kg": 0.018,
                "section": {"type": "tube", "od_m": 0.02, "id_m": 0.017}, "E_pa": 2.1e9,
                "poisson": 0.38,
            }
        ],
        "point_masses": [{"name": "servo", "frame": 2, "mass_kg": 0.12}],
    },
    "printed arm",
)  # fmt: skip
"""Its servos stand in the base: its joints carry the tube alone."""


def test_loads_are_known_where_a_mass_is_where_a_column_says() -> None:
    """No column is at hand when they are asked for."""
    declared = HEAVY_BASE.model_dump(mode="json", exclude_none=True)
    trolley = {"name": "t", "frame": 2, "mass_kg": 0.7, "position_columns": ["mx", "my", "mz"]}
    placed = Arm.parse({**declared, "point_masses": [trolley]}, "trolley")
    assert typical_loads(placed)[1] > 0.0


@pytest.mark.parametrize(("compliance", "unnamed"), [(2.2, ""), (20.0, "joint 2 compliance")])
def test_a_heavy_base_makes_no_soft_joint_implausible(compliance: float, unnamed: str) -> None:
    """It was said to be 14 priors large, and gave way to an eccentric gear with a gain."""
    rng = np.random.default_rng(0)
    q = sobol(HEAVY_BASE, 60, rng).q
    soft = loads.JointCompliance(np.array([0.0, compliance, 0.0]))
    xyz = TrueArm(HEAVY_BASE, (soft,), steps=2).tip(q) + 1.5e-5 * rng.standard_normal((60, 3))
    rows = Session.record(q, xyz)
    base = declared_model(HEAVY_BASE).plus(*geometry(HEAVY_BASE, rows))
    kinds = (JointCompliance, GearEccentricity, JointGain)
    candidates = library(HEAVY_BASE, rows.context(), kinds, base.terms).testable
    _, found = findings(search(base, rows, candidates), candidates)
    assert ("joint_compliance", ("joint 2",)) in [(f.name, f.where) for f in found]
    assert found[0].unnamed.removesuffix(" is implausibly large") == unnamed


def test_a_mass_at_a_recorded_place_has_a_typical_load() -> None:
    """Where it sits is known with a row only, so the moment that a bearing carries is not."""
    arm = declared("justin_right")
    force, torque = typical_loads(arm)
    assert torque == pytest.approx(force * reach(arm) / 4)
