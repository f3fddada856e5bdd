"""The evidence of one candidate: against plain integrals, and the loads that its prior rests on."""

import dataclasses
import gc
import weakref

import numpy as np
import pytest
from demo_rows import session_of
from discover_rows import DEMO

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import Marginal
from longarm_comp.core.effects.compliances import JointCompliance, LinkStiffness
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.typical_loads import reach, typical_loads
from longarm_comp.core.identify.posterior.offers import evidence_of_each
from longarm_comp.core.model.model import Model
from studies.real_sessions import declared_arm


@pytest.mark.parametrize("scale", [0.2, 1.0, 30.0])
def test_evidence_counts_the_bounds_of_a_parameter(scale: float) -> None:
    """Against the integral over the possible values: a beam cannot be ten times stiffer."""
    truth = dataclasses.replace(Model(DEMO), effects=())
    fitted = fit_model(
        Model(DEMO, (LinkDeflection(),)), session_of(DEMO, 7), sigma=np.full(3, 4e-4)
    )
    rigid = scale * (truth.tip(fitted.session.q) - fitted.model.tip(fitted.session.q))
    softer = Candidate("link_stiffness", (LinkStiffness(beam=DEMO.links[-1].name),))
    columns = FitColumns(fitted)
    marginal = Marginal(fitted.design, fitted.data + fitted.whiten_columns(rigid[..., None])[:, 0])
    white = fitted.whiten_columns(columns.prior_columns(softer.terms))[:, 0]
    u = np.linspace(-0.9 / 0.5, 8.0, 400_001)
    s, t = white @ marginal.project(white), white @ marginal.projected_data
    log = u * t - 0.5 * u * u * (1.0 + s)
    whole = np.trapezoid(np.exp(log - log.max()), u) / np.trapezoid(np.exp(-0.5 * u * u), u)
    (found,) = evidence_of_each(fitted, marginal, [softer])
    assert found == pytest.approx(np.log(whole) + log.max(), abs=0.02)


def test_columns_are_computed_once_and_go_with_their_fit() -> None:
    """Without the collector, which comes by far too late for a few large arrays."""
    fitted = fit_model(
        Model(DEMO, (LinkDeflection(),)), session_of(DEMO, 7), sigma=np.full(3, 4e-4)
    )
    softer = (LinkStiffness(beam=DEMO.links[-1].name),)
    first = FitColumns(fitted).white_columns(softer)
    assert FitColumns(fitted).white_columns(softer) is first
    gone = weakref.ref(fitted)
    gc.collect()
    gc.disable()
    try:
        del fitted
        assert gone() is None
    finally:
        gc.enable()


def test_loads_are_known_where_a_mass_is_where_a_column_says() -> None:
    """No column is at hand when they are asked for."""
    plain = DEMO.model_dump(mode="json", exclude_none=True)
    trolley = {"name": "t", "frame": 2, "mass_kg": 0.7, "position_columns": ["mx", "my", "mz"]}
    placed = Arm.parse({**plain, "point_masses": [trolley]}, "trolley")
    assert typical_loads(placed).torque > 0.0


def test_a_mass_at_a_recorded_place_has_a_typical_load() -> None:
    """Where it sits is known with a row only, so the moment that a bearing carries is not."""
    arm = declared_arm("justin_right")
    force, torque, _ = typical_loads(arm)
    assert torque == pytest.approx(force * reach(arm) / 4)


def test_what_carries_less_is_expected_to_be_softer() -> None:
    """By the root of its load: of the arm's own weight and of a payload of a third of that."""
    loads = typical_loads(DEMO)
    each = [loads.at(row.id) for row in DEMO.joints]
    assert each[0] == loads.torque == loads.at(0)
    assert each == sorted(each, reverse=True)
    assert each[-1] == pytest.approx(0.5 * loads.torque, rel=0.2)
    shares = [4.0 * share for share in loads.shares]
    assert loads._replace(shares=tuple(shares)).at(3) == pytest.approx(2.0 * each[2])
    soft, stiff = (JointCompliance(row).parameters(DEMO)[0].prior for row in (5, 1))
    assert soft / stiff == pytest.approx(each[0] / each[4])
    weightless = Arm.parse({**DEMO.model_dump(mode="json", exclude_none=True), "links": [],
                            "point_masses": [], "payload": None}, "light")  # fmt: skip
    lighter = typical_loads(weightless)
    assert [lighter.at(row.id) for row in DEMO.joints] == pytest.approx(
        [lighter.torque * np.sqrt(share) for share in lighter.shares]
    )
    assert lighter.shares[0] == 1.0 and lighter.shares[-1] < 0.5


def test_the_data_without_an_effect_are_those_of_its_own_columns() -> None:
    """A fit that ends early keeps the design before its last step; the columns on offer are new."""
    rows = session_of(DEMO, 1, JointCompliance(2, compliance=8e-3))
    fitted = fit_model(Model(DEMO, (LinkDeflection(),)).plus(JointCompliance(2)), rows)
    (soft,) = (t for t in fitted.model.terms if isinstance(t, JointCompliance))
    (k,) = (n for n, slot in enumerate(fitted.slots) if slot.owner is soft)
    columns = fitted.columns.copy()
    columns[..., k] *= 0.9
    early = dataclasses.replace(fitted, columns=columns)
    new, old = (FitColumns(each).marginal_without({soft.key}) for each in (fitted, early))
    np.testing.assert_allclose(new.y, old.y)
    left = FitColumns(early).white_columns([soft])[:, 0] * soft.compliance
    left = new.y - left / soft.parameters(DEMO)[0].width
    np.testing.assert_allclose(left, fitted.whiten_columns(fitted.residual[..., None])[:, 0])
