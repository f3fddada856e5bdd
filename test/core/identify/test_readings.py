"""Joint readings: what acts before the encoders, and what a diagnosis makes of them."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bag_robot import command, robot, row_said, sighting, state
from few_effects import names_alone
from hidden_arm import at
from numeric_columns import numeric_columns
from read_arm import ARM, ENCODERS, SIGMA, heavy, readings, sensed, session
from small_arm import ARM as SMALL

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.noise import noise_from_repeats
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.data.measurement import compute_posture, make_equations
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import BearingTilt, JointCompliance, ServoDroop
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import Encoder
from longarm_comp.core.effects.masses import TipPayload
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis, ServoDeadband
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.diagnosis import SPLITS, Diagnosis
from longarm_comp.core.model.by_readings import by_readings
from longarm_comp.core.model.model import Model
from longarm_comp.core.planning.optimal_poses import Uncertainty
from longarm_comp.report.assemble import build_report
from longarm_comp.report.detail import detail
from longarm_comp.report.pages import write_report
from longarm_comp.sessions.bag import read_bag
from longarm_comp.sessions.csv import read_csv, write_csv
from longarm_comp.sim.hidden import drives
from longarm_comp.sim.hidden.geometry import DhError

DROOP = drives.ServoDroop(at(3, 1.5e-3))
RIVALS = (
    ServoDroop,
    JointCompliance,
    Backlash,
    FrictionHysteresis,
    BearingTilt,
    GearEccentricity,
    JointGain,
)
"""What may act at one joint."""


Kinds = tuple[type[Effect], ...]


def soft(*joints: int) -> drives.HiddenEffect:
    """Joints that give way behind their encoders."""
    from longarm_comp.sim.hidden.loads import JointCompliance as Soft

    return Soft(sum(at(j, 2e-3) for j in joints))


def shown(arm: Arm, term: Effect, q: np.ndarray) -> np.ndarray:
    """(N, n) by how much the encoders see the joints displaced."""
    model, rows = Model(arm, (term,)), Session.record(q, np.zeros((len(q), 3)))
    motion = model.motion(compute_posture(model, rows), ())
    read = [motion.read(k)[0] for k in range(arm.n)]
    return np.concatenate(read, axis=1) - q


@pytest.mark.parametrize(
    ("encoder", "term", "seen"),
    [
        ("motor", ServoDroop(2, compliance=1e-3), True),
        ("motor", JointCompliance(2, compliance=1e-3), False),
        ("joint", ServoDroop(2, compliance=1e-3), True),
        ("joint", JointCompliance(2, compliance=1e-3), True),
    ],
)
def test_an_encoder_sees_what_acts_before_it(encoder: str, term: Effect, seen: bool) -> None:
    q = session(n=20).q
    off = shown(heavy(encoder=encoder), term, q)
    assert (np.abs(off[:, 1]) > 1e-4).all() == seen
    assert not off[:, [0, 2, 3]].any()


def test_readings_move_as_their_columns_say() -> None:
    """Also by what acts through the loads, by the encoder itself, and through its scale."""
    rows = session((DROOP,))
    terms = (ServoDroop(2, compliance=1e-3), JointCompliance(2, compliance=1e-3))
    off = Encoder(2, zero=0.01, scale=0.1)
    model = Model(ARM, (*terms, *TipPayload.for_arm(ARM))).plus(off)
    at_rows = compute_posture(model, rows)
    columns = make_equations(model, rows, at=at_rows).columns[:, 3:]
    for k, slot, whole in numeric_columns(model, rows, lambda slot: 1e-3 * slot.parameter.prior):
        want = whole[:, 3:]
        limit = 0.02 * max(np.abs(want).max(), 4.0)
        np.testing.assert_allclose(columns[..., k], want, atol=limit, err_msg=slot.label)
        if slot.parameter.name in ("compliance", "mass", "zero", "scale"):
            assert np.abs(want).max() > 1e-3, slot.label


def test_a_reading_of_a_joint_beside_the_chain_is_its_own() -> None:
    """What its motor does shows in the rows that follow it, by their share."""
    data = heavy().model_dump(mode="json", exclude_defaults=True)
    del data["joints"][2]["limits_deg"]
    data["joints"][2]["mimic"] = {"joint": 2, "multiplier": -2.0}
    data["joints"][1]["moves"] = False
    arm = Arm.parse(data, "belt")
    q = np.full((1, arm.n), 0.05)
    off = shown(arm, ServoDeadband(2, width=2e-3), q)
    assert np.abs(off) == pytest.approx(np.array([[0.0, 1e-3, 0.0]]))


def test_rows_without_readings_are_what_they_were() -> None:
    """Byte for byte: the equations of the tip, beside readings or not."""
    with_them, without = session((DROOP,)), session((DROOP,), encoders=False)
    np.testing.assert_array_equal(with_them.xyz, without.xyz)
    assert without.plain and without.hash != with_them.hash
    terms = [t for t in geometry_terms(ARM, with_them) if not isinstance(t, Encoder)]
    assert tuple(terms) == geometry_terms(ARM, without)
    model = Model(ARM, (ServoDroop(2),)).plus(*terms)
    alone = make_equations(model, without)
    beside = make_equations(model, with_them)
    assert alone.residual.tobytes() == beside.residual[:, :3].tobytes()
    assert alone.columns.tobytes() == np.ascontiguousarray(beside.columns[:, :3]).tobytes()


def test_zero_scale_and_noise_of_every_encoder_are_found() -> None:
    rows = session((DROOP,), n=200)
    fitted = fit_model(Model(ARM, (ServoDroop(3),)).plus(*geometry_terms(ARM, rows)), rows)
    held = {t.joint: t for t in fitted.model.biases if isinstance(t, Encoder)}
    for k, row in enumerate(ARM.commanded):
        assert held[row].zero == pytest.approx(ENCODERS.zero[k], abs=5e-5)
        assert held[row].scale == pytest.approx(1e-3, abs=3e-4)
    droop = next(t for t in fitted.model.effects if isinstance(t, ServoDroop))
    assert droop.compliance == pytest.approx(1.5e-3, rel=0.03)
    assert fitted.sigma[3:] == pytest.approx(np.full(4, ENCODERS.step / np.sqrt(12)), rel=0.2)


def test_repeats_say_nothing_of_an_encoder() -> None:
    """It repeats its rounding, which is not noise."""
    q = np.repeat(session(n=20).q, 3, axis=0)
    rng = np.random.default_rng(5)
    xyz = Model(ARM).tip(q) + 2e-4 * rng.standard_normal((60, 3))
    told = readings(np.round(q, 3))
    found = noise_from_repeats(Model(ARM), Session.record(q, xyz, readings=told))
    assert found is not None and np.isfinite(found.sigma[:3]).all()
    assert np.isinf(found.sigma[3:]).all()


def test_two_cameras_do_not_make_two_encoders() -> None:
    q = session(n=20).q
    sensor = np.where(np.arange(20) % 2, "left", "right")
    rows = Session.record(q, Model(ARM).tip(q), labels={"sensor": sensor}, readings=readings(q))
    assert rows.channels == (
        "left x", "left y", "left z", "right x", "right y", "right z",
        "read_q1", "read_q2", "read_q3", "read_q4",
    )  # fmt: skip
    assert rows.measured[:, -1].all()


def diagnosed(
    *hidden: drives.HiddenEffect, n: int = 120, encoders: bool = True, kinds: Kinds | None = RIVALS
) -> Diagnosis:
    """By names alone, proved by rows of its own."""
    rows, held = (session(hidden, c, s, encoders=encoders) for c, s in ((n, 1), (40, 9)))
    with names_alone():
        return diagnose(ARM, rows, test=held, kinds=kinds)


@cache
def drooping() -> Diagnosis:
    """Of a servo that gives way, read."""
    return diagnosed(DROOP)


def test_a_servo_that_gives_way_is_named_by_its_reading() -> None:
    (found,) = drooping().findings
    assert (found.names, found.where) == (("servo_droop",), ("joint 3",))


def test_a_report_says_what_the_encoders_say(tmp_path: Path) -> None:
    """What the servo gives way, and how little of it the model leaves."""
    write_report(build_report(drooping(), "0" * 64), detail(drooping(), {}), tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "What the encoders say" in page and "effects behind it do not." in page
    lines = detail(drooping(), {}).encoders
    assert lines is not None and [line[0] for line in lines.rows] == list(ARM.joint_names)
    rows = drooping().fit.session.take(drooping().fit.weights > 0)
    for k, (_, mean, _, _, left, noise, unit) in enumerate(lines.rows):
        off = 1e3 * (rows.readings[f"read_q{k + 1}"][:, 0] - rows.q[:, k])
        assert (unit, mean) == ("mrad", pytest.approx(off.mean()))
        assert left == pytest.approx(noise, rel=0.3)
    assert max(lines.rows, key=lambda line: line[2])[0] == ARM.joint_names[2]


def test_poses_to_measure_ask_for_nothing_that_readings_tell() -> None:
    """Joints that were read will be read again: then any pose splits droop from softness."""
    left = []
    for encoders in (True, False):
        rows = session((DROOP, soft(3)), n=30, encoders=encoders)
        model = Model(ARM, (ServoDroop(3), JointCompliance(3)))
        known = Uncertainty.of(model, rows, "position", known=True, sigma=(1.0, 1.0))
        assert known.sigma[0] == pytest.approx(SIGMA, rel=0.4)
        sag = next(k for k, s in enumerate(known.model.slots) if s.owner.name == "servo_droop")
        x = known.measures(sobol(ARM, 10, 0), "position")
        assert x.shape[1] == (7 if encoders else 3)
        flat = x.reshape(-1, x.shape[2])
        left.append(np.linalg.inv(known.information + flat.T @ flat)[sag, sag])
    assert left[0] < 1e-3 * left[1]


@pytest.mark.long
@pytest.mark.parametrize(
    ("hidden", "name", "places"),
    [
        ((soft(3),), "joint_compliance", ["joint 3"]),
        ((drives.Backlash(at(3, 3e-3), np.inf),), "friction_hysteresis", ["joint 3"]),
    ],
)
def test_a_reading_names_what_no_pose_can(hidden, name, places) -> None:
    """Droop and softness are one set without readings; play is not in the servo."""
    found = diagnosed(*hidden).findings
    assert [(f.names, list(f.where)) for f in found] == [((name,), places)]


def test_without_a_reading_droop_and_softness_stay_a_set() -> None:
    """And the report says what would split it."""
    diagnosis = diagnosed(soft(3), encoders=False)
    (found,) = diagnosis.findings
    assert {"joint_compliance", "servo_droop"} <= set(found.names)
    page = detail(diagnosis, {})
    assert not page.encoders
    said = [s.reason for s in page.splits if "servo_droop" in s.reason]
    assert said and all("(read_q3)" in reason for reason in said)


def test_no_pose_splits_two_names_of_one_physics_at_some_joints() -> None:
    """Soft joints 2 and 4: the other name is tried at these two, and only readings tell."""
    found = diagnosed(soft(2, 4), encoders=False)
    (finding,) = found.findings
    assert finding.where == ("joint 2", "joint 4") and "servo_droop" in finding.names
    other = next(a.candidate for a in finding.alternatives if a.name != finding.name)
    assert other.where == finding.where
    (split,) = found.split_by
    assert split.log_bayes_factor < SPLITS
    (said,) = detail(found, {}).splits
    assert said.poses == 0 and "(read_q2, read_q4)" in said.reason


@pytest.mark.parametrize("half", [pytest.param(5e-4, marks=pytest.mark.long), 2e-3])
def test_play_at_a_vertical_axis_that_leans_is_found_beside_a_soft_joint(half: float) -> None:
    """The load at joint 1 is that of its lean alone, and decides nothing."""
    lean = np.zeros((4, ARM.n))
    lean[0, 0] = 2e-3
    hidden = soft(2), drives.Backlash(at(1, half), np.inf), DhError(lean)
    kinds = RIVALS if half > 1e-3 else None
    found = diagnosed(*hidden, n=200, encoders=False, kinds=kinds).findings
    assert {
        f.where: set(f.names) >= {n}
        for f, n in zip(
            sorted(found, key=lambda f: f.where), ("backlash", "joint_compliance"), strict=True
        )
    } == {("joint 1",): True, ("joint 2",): True}


def test_both_at_one_joint_are_both_found() -> None:
    found = diagnosed(DROOP, soft(3)).findings
    assert {f.names for f in found} == {("servo_droop",), ("joint_compliance",)}


def test_a_session_keeps_its_readings_in_a_file(tmp_path: Path) -> None:
    rows = session((DROOP,))
    part = dict(rows.readings)
    part["read_q2"] = np.where(np.arange(120)[:, None] < 5, np.nan, part["read_q2"])
    rows = dataclasses.replace(rows, readings=part, blocks=())
    write_csv(rows, tmp_path / "samples.csv")
    again = read_csv(tmp_path / "samples.csv", ARM)
    assert again.hash == rows.hash
    assert again.read_joints == (0, 1, 2, 3)
    assert again.measured[:, 4].sum() == 115


def test_a_reading_of_a_joint_that_the_arm_lacks_is_refused(tmp_path: Path) -> None:
    write_csv(session(), tmp_path / "samples.csv")
    text = (tmp_path / "samples.csv").read_text().replace("read_q4", "read_q5")
    (tmp_path / "samples.csv").write_text(text)
    with pytest.raises(InputError, match="read_q5"):
        read_csv(tmp_path / "samples.csv", ARM)


def test_play_is_behind_a_motors_encoder_and_before_a_joints() -> None:
    q = session(n=5).q
    play = Backlash(2, width=0.01)
    rows = Session.record(q, np.zeros((5, 3)), approach=np.ones(5))
    for encoder, amount in (("motor", 0.0), ("joint", 0.005)):
        model = Model(heavy(encoder=encoder), (play,))
        read = model.motion(compute_posture(model, rows), ()).read(1)[0][:, 0]
        assert np.abs(read - q[:, 1]) == pytest.approx(np.full(5, amount))


# ------------------------------------------------------------------ the tip by readings


def test_the_tip_by_readings_needs_no_model_of_the_servos() -> None:
    """Nearer than by command, and it says so; where the servos droop as never before, too."""
    rows = session((DROOP, soft(3)), n=150, seed=2)
    terms = (ServoDroop(3), JointCompliance(3))
    fitted = fit_model(Model(ARM, terms).plus(*geometry_terms(ARM, rows)), rows)
    model = with_uncertainty(fitted)
    worse = drives.ServoDroop(3 * DROOP.compliance)
    fresh = sensed((worse, soft(3)), seed=7)
    by_command = np.linalg.norm(model.tip(fresh.q) - fresh.tip, axis=1).mean()
    arm = by_readings(model)
    off = np.linalg.norm(arm.tip(fresh.read) - fresh.tip, axis=1)
    assert off.mean() < 0.1 * by_command
    said = [expected_miss(arm, q, Context(), arm.tip(q)).sizes[0] for q in fresh.read[:40]]
    assert off[:40].mean() == pytest.approx(np.mean(said), rel=0.5)


def test_a_zero_that_runs_together_with_the_droop_does_not_widen_the_tip_by_readings() -> None:
    """Zero, deadband and joint zero of one joint: their sum at the tip is known."""
    rows = session((DROOP, drives.ServoDeadband(at(3, 1e-3), 0.0)), n=150)
    fitted = fit_model(
        Model(ARM, (ServoDroop(3), ServoDeadband(3))).plus(*geometry_terms(ARM, rows)), rows
    )
    off = {s.label: e for s, e in zip(fitted.slots, fitted.standard_errors, strict=True)}
    model = with_uncertainty(fitted)
    arm, q = by_readings(model), session(n=5).q
    said = [expected_miss(arm, v, Context(), arm.tip(v)).sizes[0] for v in q]
    assert off["encoder / joint 3 / zero"] > 1e-3
    assert max(said) < 3e-4


def test_a_bag_holds_where_the_joints_stood_at_rest(tmp_path: Path) -> None:
    """The mean of the readings at rest, none of the way there; blank where they did not rest."""
    goal, droop = np.array([0.1, 0.5, 0.05, 0.2]), np.array([0.0, -4e-3, 1e-4, 0.0])
    flicker = np.array([0.0, 2e-4, 0.0, 0.0])
    with robot(tmp_path / "bag") as put:
        for k, at_s in enumerate((1.0, 4.0)):
            command(put, at_s, list(goal + 0.1 * k))
            for n in range(25):
                left = max(0.0, 0.2 - n / 10) if k == 0 else 0.02 * (n % 2)
                q = goal + 0.1 * k + droop - left + flicker * (n % 2)
                state(put, at_s + 0.1 + n / 10, q.tolist())
            sighting(put, at_s + 2.5, [0.4, 0.1, 0.3])
        row_said(put, 6.6, index=1)
    rows = read_bag(tmp_path / "bag", SMALL)
    found = np.concatenate([rows.readings[f"read_q{k}"] for k in range(1, 5)], axis=1)
    np.testing.assert_allclose(found[0], goal + droop + 0.5 * flicker, atol=1e-5)
    assert len(rows) == 1 or np.isnan(found[1]).all()
    assert rows.seen[0]
