"""Commands at a payload or warmth that no row of the session had: said, and in the promise."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import DEMO_ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.uncertainty import FRAME, with_uncertainty
from longarm_comp.core.compensation.beyond import (
    KNOWN_TO,
    absent_slots,
    beyond_session,
    outside_data,
)
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.expected import ExpectedMiss
from longarm_comp.core.compensation.unknown import unknown_circumstances
from longarm_comp.core.compensation.weighing import SD
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraDrift
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.slow_changes import BaseSettling
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, save_model, store

ARM = Arm.load(DEMO_ARM)
assert ARM.payload is not None
OWN_KG = ARM.payload.mass_kg
Q = sobol(ARM, 8, 3).q
HOUR = np.linspace(0.0, 3600.0, 60)


def learned(*effects: Effect | Bias, noise: float = 1e-4, **columns: np.ndarray) -> Model:
    """Fitted to rows of the declared payload, or of what the columns say."""
    true = declared_model(ARM).plus(*effects)
    q = sobol(ARM, 60, 1).q
    seen = true.measured(q, Context(columns=columns))
    seen = seen + noise * np.random.default_rng(0).standard_normal((60, 3))
    rows = Session.record(q, seen, columns=columns)
    return with_uncertainty(fit_model(true.plus(*JointZero.for_arm(ARM)), rows))


SOFT = JointCompliance(2, compliance=1e-3)


def at(payload_kg: float) -> Context:
    return Context(columns={"payload_kg": payload_kg})


def test_a_part_of_an_unknown_miss_is_no_promise() -> None:
    """What a payload adds was promised alone, where nothing told the rest."""
    unknown = ExpectedMiss(np.zeros(3), np.full((3, 3), np.nan))
    assert np.isnan(unknown.plus(1e-6 * np.eye(3)).sizes).all()
    known = ExpectedMiss(np.zeros(3), 1e-6 * np.eye(3)).plus(3e-6 * np.eye(3))
    np.testing.assert_allclose(known.sigma, 2e-3)


def test_within_the_session_nothing_is_added() -> None:
    model = learned(SOFT, payload_kg=np.linspace(0.1, 0.5, 60))
    for kg in (0.1, 0.3, 0.5):
        spread, why = beyond_session(model, Q, at(kg))
        assert not spread.any() and why == [""] * len(Q)


@pytest.mark.parametrize("kg", [0.0, 1.5])
def test_beyond_it_a_fifth_of_what_the_physics_says_is_not_known(kg: float) -> None:
    """On either side of the range, from its nearer edge."""
    model = learned(SOFT, payload_kg=np.linspace(0.2, 0.5, 60))
    spread, why = beyond_session(model, Q, at(kg))
    moved = model.tip(Q, at(kg)) - model.tip(Q, at(0.2 if kg < 0.2 else 0.5))
    np.testing.assert_allclose(spread, KNOWN_TO * np.abs(moved), rtol=1e-6)
    assert all("payload_kg" in each and "0.2 to 0.5" in each for each in why)


def test_a_session_that_tells_no_payload_had_the_declared_one() -> None:
    model = learned(SOFT)
    assert not beyond_session(model, Q, at(OWN_KG))[0].any()
    assert beyond_session(model, Q, at(OWN_KG + 1.0))[0].any()


@pytest.mark.parametrize(
    ("column", "declared", "other"),
    [("temperature_c", ARM.reference_temperature_c, 60.0), ("incl_0_x", 0.0, 0.05)],
)
def test_what_no_row_tells_counts_as_declared(column: str, declared: float, other: float) -> None:
    """A warm arm, or one on a tilted base, was not calibrated so: the promise knows."""
    model = learned(SOFT)
    assert not beyond_session(model, Q, Context(columns={column: declared}))[0].any()
    spread, why = beyond_session(model, Q, Context(columns={column: other}))
    assert (np.linalg.norm(spread, axis=1) > 1e-3).all()
    assert all(each.startswith(f"{column} {other:.4g} is beyond") for each in why)


def test_causes_without_a_name_that_feel_the_load_make_the_physics_less_sure() -> None:
    """One of the joints alone may, where no row had another load."""
    load, joints = (
        Discovered("joint 3", "turn z", f"linear({of})", f"{of} {low}..{high}", 0.1, amount)
        for of, low, high, amount in (("sum_loads", 0.0, 60.0, 8e-3), ("q2", -1.0, 1.0, 0.2))
    )
    some = {"payload_kg": np.linspace(0.0, OWN_KG, 60)}
    known = []
    for effect, columns in ((load, {}), (load, some), (joints, {}), (joints, some)):
        model = learned(SOFT, effect, **columns)
        moved = model.tip(Q, at(2.0)) - model.tip(Q, at(OWN_KG))
        spread = beyond_session(model, Q, at(2.0))[0]
        known.append(np.linalg.norm(spread, axis=1) / np.linalg.norm(moved, axis=1))
    assert all((each >= KNOWN_TO).all() and each.mean() > 2.0 * KNOWN_TO for each in known[:3])
    assert known[2].max() > 1.1  # more than all that the model says of it: more may yield
    np.testing.assert_allclose(known[3], KNOWN_TO, rtol=1e-6)


@pytest.mark.parametrize("compliance", [1e-3, 4e-3])
def test_an_arm_calibrated_as_stiff_may_yield_under_more_load(compliance: float) -> None:
    """Its geometry holds the sag of its rows, and nothing says how it sags under more."""
    soft, q = JointCompliance(2, compliance=compliance), sobol(ARM, 60, 1).q
    true = declared_model(ARM).plus(soft)
    seen = true.tip(q, Context()) + 1e-4 * np.random.default_rng(0).standard_normal((60, 3))
    *_, (_, fitted) = fit_stages(declared_model(ARM), Session.record(q, seen))
    stiff, promised = with_uncertainty(fitted), []
    for kg in (OWN_KG, OWN_KG + 0.5):
        targets = stiff.tip(sobol(ARM, 60, 3).q, at(kg))
        found = [c for c in compensate(stiff, None, targets, context=at(kg)) if c.success]
        commands, p90 = np.array([c.command for c in found]), np.array([c.p90_m for c in found])
        missed = np.linalg.norm(true.tip(commands, at(kg)) - stiff.tip(commands, at(kg)), axis=1)
        assert len(found) > 40 and (missed < p90).mean() > 0.85
        promised.append(p90.mean())
    assert promised[1] > 1.5 * promised[0]
    assert promised[1] < 3.0 * missed.mean()  # the record counts it once


def test_warmth_that_never_changed_may_do_what_the_library_holds() -> None:
    cold = learned(SOFT, temperature_c=np.full(60, 20.0))
    spread, (why, *_) = beyond_session(cold, Q, Context(columns={"temperature_c": 45.0}))
    assert (spread > 0).any() and "temperature_c 45 is beyond the session's 20 (sigma " in why
    assert not beyond_session(cold, Q, Context(columns={"temperature_c": 20.0}))[0].any()


def test_the_command_says_it_and_promises_less(tmp_path: Path) -> None:
    """Also with the model of a file."""
    model = learned(SOFT)
    save_model(tmp_path / "model.yaml", store(model))
    again = load_model(tmp_path / "model.yaml", ARM)
    target = model.tip(ARM.mid[None])[0]
    for each in (model, again):
        near, far = (compensate(each, None, target, context=at(kg))[0] for kg in (OWN_KG, 3.0))
        assert "beyond the session" in far.reason and "beyond" not in near.reason
        assert far.p90_m > 2.0 * near.p90_m


RISING = Discovered("joint 3", "turn z", "linear(q2)", "q2 -0.1..0.1", 0.1, 0.2)


@pytest.mark.parametrize("effects", [(), (SOFT,), (SOFT, RISING)])
def test_machine_code_says_the_same_of_a_load(
    effects: tuple[Effect, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No load pass and no column is computed by the model's own code, if all causes have names."""
    model = learned(*effects, temperature_c=np.full(60, 20.0))
    heavy = Context(columns={"payload_kg": OWN_KG + 1.0, SD: 0.1, "temperature_c": 20.0})
    own = [f(model, Q, heavy) for f in (unknown_circumstances, outside_data)]
    assert len(absent_slots(model, heavy)[0]) > len(absent_slots(model, at(OWN_KG))[0])
    ik.warm_up(model, heavy)
    with ik.compile_at_once():
        unknown_circumstances(model, Q, heavy)
    for name in () if RISING in effects else ("_pass_loads", "motion"):
        monkeypatch.delattr(Model, name)
    for (spread, why), (by_own, said) in zip(
        [f(model, Q, heavy) for f in (unknown_circumstances, outside_data)], own, strict=True
    ):
        np.testing.assert_allclose(spread, by_own, rtol=1e-6, atol=1e-12)
        assert why == said


def test_a_model_of_before_says_nothing_of_its_session() -> None:
    model = learned(SOFT)
    assert model.uncertainty is not None
    silent = replace(model, uncertainty=replace(model.uncertainty, circumstances={}))
    assert not beyond_session(silent, Q, at(9.0))[0].any()


def test_a_camera_that_drifts_leaves_the_frame_of_targets_in_doubt(tmp_path: Path) -> None:
    """By what it drifted from the middle of the session to its ends, here 0.9 mm along x."""
    model = learned(CameraDrift(x=1.8e-3), noise=0.0, t_s=HOUR)
    save_model(tmp_path / "model.yaml", store(model))
    again = load_model(tmp_path / "model.yaml", ARM)
    for each in (model, again):
        assert each.uncertainty is not None
        sigma = np.sqrt(np.diag(each.uncertainty.frame))
        assert sigma[0] == pytest.approx(1.8e-3 * FRAME / np.sqrt(12.0), rel=0.1)
        assert (sigma[1:] < 0.1 * sigma[0]).all()
        assert compensate(each, None, model.tip(ARM.mid[None])[0])[0].p90_m > sigma[0]
    still = learned(SOFT).uncertainty
    assert still is not None and (np.sqrt(np.diag(still.frame)) < 1e-4).all()  # of the noise


def test_a_base_that_settled_may_as_well_be_a_camera_that_rose() -> None:
    """Commands take the base as it is now; where targets are of the start, it is 0.9 mm away."""
    model = learned(BaseSettling(sink=9e-4), noise=0.0, t_s=HOUR)
    assert model.uncertainty is not None
    along = model.uncertainty.frame[2, 2]
    assert np.sqrt(along) == pytest.approx(9e-4 * FRAME / np.sqrt(3.0), rel=0.05)
    assert np.trace(model.uncertainty.frame) == pytest.approx(along, rel=1e-3)
