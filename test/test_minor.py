"""What is certain but does not matter, or is at the limit of what is possible, gets no name."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hidden_arm import SIGMA, at, session
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.bearing_tilt import BearingTilt
from longarm_comp.core.effects.gear_eccentricity import GearEccentricity
from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.link_stiffness import LinkStiffness
from longarm_comp.core.effects.measured_tilt import MeasuredTilt
from longarm_comp.core.effects.servo_quantisation import ServoQuantisation
from longarm_comp.core.effects.thermal_growth import ThermalGrowth
from longarm_comp.core.identify.aliasing import findings
from longarm_comp.core.identify.candidates import library
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.evidence import columns_at, shift_of
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.minor import Minor, smallest, taken_out
from longarm_comp.core.model.model import Model
from longarm_comp.report.assemble import assemble
from longarm_comp.sim.hidden import drives


@pytest.fixture(scope="module")
def demo(demo_arm_path: Path) -> Arm:
    return Arm.load(demo_arm_path)


def of_truth(
    truth: Model, n: int, columns: dict[str, np.ndarray] | None = None, seed: int = 5
) -> Session:
    """Rows of a model, with the usual noise."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(truth.arm.lower, truth.arm.upper, (n, truth.arm.n))
    rows = Session.record(q, np.zeros((n, 3)), columns=columns or {})
    return dataclasses.replace(
        rows, xyz=truth.tip(q, rows.context()) + SIGMA * rng.standard_normal((n, 3))
    )


def states(found: Diagnosis) -> dict[tuple[str, str], str]:
    return {(c["effect"], c["where"]): c["why"] for c in assemble(found, "")[0]["candidates"]}


def test_an_effect_that_is_certain_but_tiny_is_listed_and_not_named() -> None:
    """0.03 mm in 2000 rows of 0.35 mm of noise."""
    found = diagnose(ARM, session([drives.JointGain(at(2, 1.6e-3))], n=2000), kinds=(JointGain,))
    assert [m.name for m in found.minor] == ["joint_gain"]
    assert found.minor[0].worth_m < 4e-5
    assert (found.verdict, found.findings) == ("noise", ())
    assert "joint_gain" not in {e.name for e in found.model.effects}
    assert "too small to matter" in found.summary
    assert "too small to matter" in states(found)["joint_gain", "joint 2"]


@pytest.mark.parametrize(("gain", "stays"), [(6e-4, False), (7e-4, True)])
def test_a_place_that_the_noise_hides_goes_and_the_others_stay(gain: float, stays: bool) -> None:
    gains = drives.JointGain(at(2, 0.02) + at(1, gain))
    found = diagnose(ARM, session([gains], n=2000), kinds=(JointGain,))
    both = ("joint 1", "joint 2")
    assert [f.where for f in found.findings] == [both if stays else ("joint 2",)]
    gone = [] if stays else [("joint_gain", ("joint 1",))]
    assert [(m.name, m.where) for m in found.minor] == gone


def test_the_worth_of_a_finding_leaves_out_what_the_geometry_takes_up() -> None:
    """A gain of 2 % turns joint 2 by 14 mrad on average, of which the joint's zero takes most."""
    whole = session([drives.JointGain(at(2, 0.02))], n=300)
    diagnosed = diagnose(ARM, whole, kinds=(JointGain,))
    found, fitted = diagnosed.findings[0], diagnosed.fit
    without = diagnose(ARM, whole, kinds=()).search.fit.residual
    noise = 3 * SIGMA**2
    assert found.worth_m**2 == pytest.approx((without**2).sum(1).mean() - noise, rel=0.1)
    moved = shift_of(fitted, columns_at(fitted), found.terms)
    assert np.sqrt((moved**2).sum(1).mean()) > 1.5 * found.worth_m
    assert found.share == pytest.approx(1 - noise / (without**2).sum(1).mean(), rel=0.05)


def test_an_impossible_size_is_no_finding(demo: Arm) -> None:
    """A beam cannot be stiffer than ten times; one that does not bend at all is something else."""
    found = diagnose(demo, of_truth(Model(demo), 200), kinds=(LinkStiffness,))
    assert not any(
        term.softness == -0.9 for term in found.model.effects if isinstance(term, LinkStiffness)
    )
    assert found.verdict != "named"


def test_a_place_stays_that_others_can_replace_by_incredible_sizes_only() -> None:
    """At three levels of joint 2 an eccentricity may stand for the gain: with 80 mrad."""
    rows = session([drives.JointGain(at(2, 0.1))], levels=3)
    one = diagnose(ARM, rows, kinds=(JointGain,)).search
    both = fit(one.fit.model.plus(GearEccentricity(2, order=1)), one.fit.session)
    gain = next(t for t in both.model.effects if t.name == "joint_gain")
    more = (*one.chosen, GearEccentricity(2, order=1))
    kept, gone = taken_out(
        dataclasses.replace(one, fit=both, chosen=more),
        lambda now: iter([((gain,), Minor.of((gain,), 0.0, "asked"))] if now.fit is both else []),
        lambda said: None,
    )
    assert gone == ()
    assert kept.fit is both


@pytest.mark.parametrize(("share", "open_"), [(0.9, True), (1.1, False)])
def test_a_name_that_others_could_do_without_is_open(
    share: float, open_: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was kept because they would be of sizes that nobody believes."""
    one = diagnose(ARM, session([drives.JointGain(at(2, 0.02))]), kinds=(JointGain,)).search
    own = share * smallest(one.fit)
    monkeypatch.setattr("longarm_comp.core.identify.aliasing.worth", lambda *args: own)
    _, (gain,) = findings(one, ())
    assert gain.open == open_
    assert gain.unnamed.startswith("only 0.0") == open_


@pytest.mark.parametrize(("most_m", "stays"), [(1e-5, True), (np.inf, False)])
def test_a_place_stays_that_is_worth_more_than_was_estimated(most_m: float, stays: bool) -> None:
    one = diagnose(ARM, session([drives.JointGain(at(2, 0.02))]), kinds=(JointGain,)).search
    gain = Minor.of(one.chosen, 0.0, "asked", most_m)
    asked = taken_out(
        one,
        lambda now: iter([(one.chosen, gain)] if now.chosen else []),
        lambda said: None,
    )
    assert one.chosen
    assert asked[1] == (() if stays else (gain,))
    assert bool(asked[0].chosen) == stays


def test_what_never_changed_is_not_testable() -> None:
    rows = of_truth(Model(ARM), 40, {"temperature_c": np.full(40, 27.5)})
    tried = library(ARM, rows.context(), (ThermalGrowth, JointGain))
    assert {c.name for c in tried.testable} == {"joint_gain"}
    assert [name for name, _ in tried.not_testable] == ["thermal_growth"]
    assert "27.5 in all rows" in tried.not_testable[0][1]


def test_a_tilt_sensor_on_solid_ground_is_left_out() -> None:
    rng = np.random.default_rng(8)
    solid = dict(zip(("incl_0_x", "incl_0_y"), 2e-5 * rng.standard_normal((2, 150)), strict=True))
    shaky = dict(zip(("incl_3_x", "incl_3_y"), 5e-3 * rng.standard_normal((2, 150)), strict=True))
    rows = of_truth(Model(ARM, (MeasuredTilt(frame=3),)), 150, solid | shaky)
    found = diagnose(ARM, rows, kinds=(MeasuredTilt,))
    assert [(f.name, f.where) for f in found.findings] == [("measured_tilt", ("frame 3",))]


def test_a_value_at_its_bound_is_not_shown_as_an_interval(demo: Arm) -> None:
    """The bearing gives about one axis only: the other parameter is 0 or hardly more."""
    truth = Model(demo, (LinkDeflection(), BearingTilt(4, about_y=0.01)))
    found = diagnose(demo, of_truth(truth, 200, seed=6), kinds=(BearingTilt, GearEccentricity))
    assert [f.name for f in found.findings] == ["bearing_tilt"]
    by_name = {p["name"]: p["ci95"] for p in assemble(found, "")[0]["findings"][0]["parameters"]}
    assert by_name["about_x"] is None
    assert by_name["about_y"] is not None
    assert "about_x" not in found.summary


def test_steps_that_are_whole_at_the_fitted_poses_stay_with_the_others() -> None:
    """All servos are alike: of 2 deg steps, only joint 4 stands between two at these levels."""
    rng = np.random.default_rng(3)
    q = ARM.lower + rng.integers(3, size=(150, ARM.n)) / 2 * (ARM.upper - ARM.lower)
    steps = tuple(ServoQuantisation(joint=j, steps_per_turn=180) for j in (1, 2, 4))
    xyz = Model(ARM, steps).tip(q) + SIGMA * rng.standard_normal((150, 3))
    found = diagnose(ARM, Session.record(q, xyz), kinds=(ServoQuantisation,))
    assert [t.where for t in found.search.chosen] == ["joint 1", "joint 2", "joint 4"]
