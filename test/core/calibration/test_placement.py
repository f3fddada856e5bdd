"""Placement is solved: bases, tips and markers anywhere give what a declared placement gives."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from every_circumstance import circumstances, models
from few_effects import few_effects, names_alone
from scipy.spatial.transform import Rotation
from small_arm import ARM as SMALL

import longarm_comp as la
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.spatial import Frame
from longarm_comp.core.calibration import plausible
from longarm_comp.core.calibration.calibrate import fit_ladder, fit_stages
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.placed_model import placement_terms
from longarm_comp.core.calibration.placement import place_bases
from longarm_comp.core.calibration.plausible import INCREDIBLE, RISES, WORSE, WORST, describe_rise
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.data.registration import Sightings, register
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.masses import TipPayload
from longarm_comp.core.effects.placements import BasePose, TipOffset
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.identify.model_tolerance import BACKGROUND_REST
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, read_stored
from longarm_comp.sim.arm_truth import TrueArm
from studies.real_sessions import justin, laser_tracked

TURNS = [Rotation.from_rotvec([0.7, -1.1, 1.84]), Rotation.from_rotvec([-3.0, 0.3, 0.2])]
FAR = np.array([12.0, -15.0, 4.0])


def box(arm: Arm, n: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(arm.lower, arm.upper, (n, arm.n))


def moved(session: Session, turn: Rotation, offset: np.ndarray = FAR) -> Session:
    """The same measurements in another frame."""
    return dataclasses.replace(session, xyz=session.xyz @ turn.as_matrix().T + offset)


def undeclared(arm: Arm) -> Arm:
    """Without base, camera and the place of the tip."""
    data = arm.model_dump(mode="json", exclude_defaults=True)
    data.pop("base", None)
    data.pop("camera", None)
    data["tip"]["position_m"] = [0.0, 0.0, 0.0]
    return Arm.parse(data, "test")


def measured(
    truth: Model, q: np.ndarray, rng: np.random.Generator, **labels: np.ndarray
) -> Session:
    session = Session.record(q, np.zeros((len(q), 3)), labels=labels)
    xyz = truth.measured(q, session.context()) + 2e-4 * rng.standard_normal((len(q), 3))
    return Session.record(q, xyz, labels=labels)


def with_tip(arm: Arm, position: list[float], **more: object) -> Arm:
    data = {**arm.model_dump(mode="json", exclude_defaults=True), **more}
    data["tip"]["position_m"] = position
    return Arm.parse(data, "test")


# ------------------------------------------------------------------ the closed form


@pytest.mark.parametrize("far", [0.0, 0.4])
def test_bases_and_markers_are_registered_through_outliers(
    far: float, rng: np.random.Generator
) -> None:
    n = 160
    group, marker = rng.integers(0, 2, n), rng.integers(0, 2, n)
    axes = Rotation.random(n, rng=rng).as_matrix()
    point = rng.normal(0, 0.5, (n, 3))
    tip = np.array([[far, -0.02, 0.3 * far], [0.01, far, 0.0]])
    turn = np.stack([t.as_matrix() for t in TURNS])
    offset = np.array([FAR, -FAR])
    local = point + np.einsum("nij,nj->ni", axes, tip[marker])
    seen = np.einsum("nij,nj->ni", turn[group], local) + offset[group]
    wild = rng.random(n) < 0.15
    seen[wild] += rng.normal(0, 0.3, (wild.sum(), 3))
    found = register(Sightings(point, axes, seen, group, marker))
    np.testing.assert_allclose(found.rotation, turn, atol=1e-4)
    np.testing.assert_allclose(found.tip, tip, atol=1e-4)
    np.testing.assert_allclose(found.offset, offset, atol=1e-4)
    assert found.misfit < 1e-4


def test_what_the_rows_do_not_determine_stays_declared(rng: np.random.Generator) -> None:
    """A tip that never turns: its place and the base's cannot be told apart."""
    point = rng.normal(0, 0.5, (40, 3))
    axes = np.broadcast_to(np.eye(3), (40, 3, 3))
    none = np.zeros(40, dtype=int)
    found = register(Sightings(point, axes, point + FAR, none, none))
    assert found.misfit < 1e-9
    np.testing.assert_allclose(found.tip, 0.0, atol=1e-6)


def test_a_group_of_two_rows_stands_like_the_others(rng: np.random.Generator) -> None:
    group = np.repeat(["a", "b"], [40, 2])
    truth = Model(SMALL, (BasePose("a", *FAR, rz=2.0), BasePose("b", *FAR, rz=2.0)))
    session = measured(truth, box(SMALL, 42, rng), rng, group=group)
    start = place_bases(Model(SMALL, placement_terms(SMALL, session)), session)
    assert np.linalg.norm(compute_tip_errors(start, session), axis=1).max() < 0.02


# ------------------------------------------------------------------ the same results anywhere


@pytest.mark.parametrize("turn", [TURNS[0], pytest.param(TURNS[1], marks=pytest.mark.long)])
def test_an_arm_is_calibrated_alike_wherever_it_is_seen_from(
    demo: Arm, turn: Rotation, rng: np.random.Generator
) -> None:
    """Sag too: gravity follows the base."""
    true = with_tip(demo, [0.05, -0.03, 0.1])
    truth = Model(true, (LinkDeflection(), JointZero(2, offset=6e-3), JointZero(6, offset=-4e-3)))
    train, test = (measured(truth, box(true, n, rng), rng) for n in (120, 60))
    known = fit_ladder(true, train, test)
    free = fit_ladder(undeclared(demo), moved(train, turn), moved(test, turn))
    assert [rung.name for rung in free] == [rung.name for rung in known]
    for mine, declared in zip(free[1:], known[1:], strict=True):
        assert mine.held_out.rms == pytest.approx(declared.held_out.rms, rel=0.01)
    assert free[-1].held_out.rms < 5e-4
    base = next(e for e in free[-1].model.effects if isinstance(e, BasePose)).base(demo)
    assert (Rotation.from_matrix(base.matrix()[:3, :3]).inv() * turn).magnitude() < 0.01


def test_several_bases_and_markers_metres_off(rng: np.random.Generator) -> None:
    """One group or marker that is right does not hide another that is not."""
    spots = {"tip": {"frame": 4, "position_m": [0, 0.02, 0.05]}}
    spots["elbow"] = {"frame": 3, "position_m": [0.03, 0, 0]}
    arm = Arm.parse({**SMALL.model_dump(mode="json", exclude_none=True), "markers": spots}, "test")
    n = 120
    labels = {
        "group": np.where(np.arange(n) < 90, "a", "b"),
        "marker": np.where(rng.random(n) < 0.7, "tip", "elbow"),
    }
    away = BasePose("b", 3.0, -20.0, 1.0, 0.5, -1.0, 2.0)
    truth = Model(arm, (BasePose("a"), away, TipOffset("elbow", x=0.3, y=-0.1)))
    session = measured(truth, box(arm, n, rng), rng, **labels)
    found = fit_model(
        place_bases(Model(arm, placement_terms(arm, session)), session), session
    ).model
    assert np.median(np.linalg.norm(compute_tip_errors(found, session), axis=1)) < 5e-4
    elbow = next(e for e in found.effects if isinstance(e, TipOffset) and e.marker == "elbow")
    assert (elbow.x, elbow.y) == pytest.approx((0.3, -0.1), abs=1e-3)


@pytest.mark.parametrize("name", ["justin", "wam", "ur5"])
def test_real_arms_are_calibrated_alike(request: pytest.FixtureRequest, name: str) -> None:
    if name == "justin":
        part = justin(request.getfixturevalue("justin_data"))[0]
    else:
        (part,) = laser_tracked(request.getfixturevalue("data_dir"), name)
    known = fit_ladder(part.arm, part.train, part.test)
    rows = (moved(session, TURNS[0]) for session in (part.train, part.test))
    free = fit_ladder(undeclared(part.arm), *rows)
    for mine, declared in zip(free[1:], known[1:], strict=True):
        print(
            f"{name} {mine.name}: {1e3 * declared.held_out.mean:.3f} mm with the declared "
            f"placement, {1e3 * mine.held_out.mean:.3f} mm without"
        )
        assert mine.held_out.mean == pytest.approx(declared.held_out.mean, rel=0.01)


def test_every_effect_turns_with_the_base(demo: Arm) -> None:
    """What acts at the base acts in the base's axes, however far it is turned."""
    q, context = circumstances(demo)
    base = BasePose("", *FAR, *TURNS[0].as_rotvec())
    matrix = base.base(demo).matrix()
    for model in models(demo):
        rest = tuple(e for e in model.effects if not isinstance(e, BasePose))
        near = Model(demo, rest).tip(q, context)
        far = Model(demo, (base, *rest)).tip(q, context)
        np.testing.assert_allclose(far, near @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-7)


# ------------------------------------------------------------------ tolerances


def test_a_tolerance_is_a_prior(rng: np.random.Generator) -> None:
    known = {"base": {"xyz_m": 0.002, "rpy_deg": [1, 2, 3]}, "tip": {"xyz_m": [1e-3, 2e-3, 3e-3]}}
    arm = with_tip(SMALL, [0, 0.02, 0.05], tolerance=known)
    base, tip = BasePose().parameters(arm), TipOffset().parameters(arm)
    assert [p.width for p in base[:3]] == [0.002] * 3
    assert [p.width for p in base[3:]] == pytest.approx(list(np.radians([1, 2, 3])))
    assert [p.width for p in tip] == [1e-3, 2e-3, 3e-3]
    assert min(p.width for p in BasePose().parameters(SMALL)) > 20.0  # metres, radians: flat
    near = measured(Model(SMALL, (BasePose(x=4e-3),)), box(SMALL, 40, rng), rng)
    start = Model(arm, placement_terms(arm, near))
    assert place_bases(start, near) == start  # what is known is not solved
    assert arm.hash != SMALL.hash
    with pytest.raises(InputError, match=r"base.*off.*within tolerance\.base"):
        place_bases(start, moved(near, TURNS[0]))


def test_nothing_is_learned_from_an_arm_that_is_not_placed(rng: np.random.Generator) -> None:
    session = moved(measured(Model(SMALL), box(SMALL, 60, rng), rng), TURNS[0])
    with pytest.raises(JobError, match="calibrate first"):
        la.train(SMALL, session)
    la.train(SMALL, session, model=la.calibrate(SMALL, session).model, ensemble=1, init="xavier")


def test_a_tolerance_of_an_unknown_marker_is_refused() -> None:
    with pytest.raises(InputError, match=r"tolerance\.markers\.elbow.*none"):
        with_tip(SMALL, [0, 0, 0], tolerance={"markers": {"elbow": {"xyz_m": 0.01}}})


def test_a_placement_that_is_right_stays(rng: np.random.Generator) -> None:
    model = Model(SMALL, (BasePose(), TipOffset()))
    assert place_bases(model, measured(Model(SMALL), box(SMALL, 40, rng), rng)) == model


# ------------------------------------------------------------------ commands and files


def test_a_model_says_where_the_base_stands_and_targets_are_where_it_is_seen(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    session = moved(measured(Model(SMALL), box(SMALL, 80, rng), rng), TURNS[0])
    done = la.calibrate(SMALL, session)
    done.save(tmp_path / "model.yaml")
    (base,) = read_stored(tmp_path / "model.yaml").placement.values()
    angles = Rotation.from_euler("xyz", base.rpy_deg, degrees=True)
    np.testing.assert_allclose(base.xyz_m, FAR, atol=0.01)
    assert (angles.inv() * TURNS[0]).magnitude() < 0.02
    kept = load_model(tmp_path / "model.yaml", SMALL)
    q = SMALL.mid
    target = moved(Session.record([q], Model(SMALL).tip(q)[None]), TURNS[0]).xyz[0]
    (found,) = la.compensate(kept, target, position_only=True, frame="measured")
    reached = TURNS[0].apply(Model(SMALL).tip(found.command)) + FAR
    assert np.linalg.norm(reached - target) < 1e-3


def test_diagnosis_and_calibration_mean_the_same_by_calibrated(rng: np.random.Generator) -> None:
    truth = Model(SMALL, (JointZero(1, offset=6e-3),))
    session = measured(truth, box(SMALL, 120, rng), rng)
    wild = rng.random(120) < 0.05
    xyz = session.xyz + np.where(wild[:, None], 0.05, 0.0)
    session = dataclasses.replace(session, xyz=xyz)
    calibrated = la.calibrate(SMALL, session).model
    with few_effects(()), names_alone():
        diagnosed = la.diagnose(SMALL, session, network=False).diagnosis.models["calibrated"]
    np.testing.assert_allclose(diagnosed.tip(session.q), calibrated.tip(session.q), atol=2e-5)


# ------------------------------------------------------------------ what may not be believed


def test_a_calibration_that_does_not_carry_over_is_refused(rng: np.random.Generator) -> None:
    from longarm_comp.core.data.holdout import blocked_split

    session = measured(Model(SMALL), box(SMALL, 120, rng), rng)
    _, held = blocked_split(session, 0.2, rng=0)
    xyz = session.xyz + np.where(np.isin(session.index, held.index)[:, None], 0.004, 0.0)
    with pytest.raises(JobError, match="fails at held-out rows"):
        la.calibrate(SMALL, dataclasses.replace(session, xyz=xyz))


def test_a_tip_mass_that_no_arm_carries_is_refused(demo: Arm, rng: np.random.Generator) -> None:
    """The moduli in arm.yaml are ten times the true ones: only a heavy tip explains the sag."""
    data = demo.model_dump(mode="json", exclude_defaults=True)
    for beam in data["links"]:
        beam["E_pa"] /= 10.0
    q = box(demo, 80, rng)
    xyz = TrueArm(Arm.parse(data, "soft")).tip(q) + 2e-4 * rng.standard_normal((80, 3))
    with pytest.raises(JobError, match=r"tip_payload at tip: mass \d\.\d+ kg is not credible"):
        la.calibrate(demo, Session.record(q, xyz), effects=["tip_payload"])


def test_a_usual_size_is_credible_though_the_fit_expected_less(
    demo: Arm, rng: np.random.Generator
) -> None:
    """Of what every arm has a little of, a fit expects a two-hundredth of a finding."""
    start = Model(demo, (LinkDeflection(), TipPayload()))
    (slot,) = start.slots
    made = start.with_values(np.array([0.3 * slot.parameter.prior]))
    narrow = dataclasses.replace(start, beyond=((slot.identity, BACKGROUND_REST),))
    session = measured(made, box(demo, 150, rng), rng)
    final = fit_model(narrow, session, sigma=np.full(3, 1e-6), weights=np.ones(150))
    (found,) = final.model.slots
    assert found.value > INCREDIBLE * found.parameter.prior
    plausible.refuse_implausible(final, None, np.zeros((0, 3)), {})


def test_gates() -> None:
    rng = np.random.default_rng(0)
    error = 1e-3 * rng.standard_normal((40, 3))
    assert not describe_rise(error, 1.4 * error, WORSE, WORST)
    assert not describe_rise(error, 3.5 * error, RISES)
    assert re.fullmatch(r"mean 1\.\d+ -> 2\.\d+", describe_rise(error, 1.6 * error, WORSE, WORST))
    assert describe_rise(error, 4.5 * error, RISES)
    few = error[:5]
    assert describe_rise(few, 9 * few, WORSE, WORST).startswith("mean ")
    assert not describe_rise(few, 5 * few, WORSE, WORST)  # too few to tell
    assert describe_rise(error[:10], 3 * error[:10], WORSE, WORST)
    assert not describe_rise(error[:10], 2 * error[:10], WORSE, WORST)
    assert not describe_rise(few, 15 * few, RISES) and describe_rise(few, 17 * few, RISES)
    for one, other in ((few, few[:1]), (few[:1], few)):
        assert not describe_rise(one, 99 * other, WORSE, WORST)
    rows = Session.record(np.zeros((40, 1)), 1e3 * error)
    plausible.check_noise(np.full(3, 0.02), rows)
    with pytest.raises(JobError, match="more than noise"):
        plausible.check_noise(np.full(3, 0.084), rows)
    stated = dataclasses.replace(rows, sigma=np.full((len(rows), 3), 0.1))
    with pytest.raises(JobError, match=r"173 mm is stated.* sigma_x"):
        plausible.check_noise(np.full(3, 0.1), stated)
    plausible.check_noise(np.array([0.01, 5e-4, 6e-4]), rows)  # a camera's depth
    with pytest.raises(JobError, match=r"9.8 mm is left along x beside 0.3 mm, which is no"):
        plausible.check_noise(np.array([9.8e-3, 3e-4, 3e-4]), rows)
    late = np.r_[error[:36], 5 * error[36:]]  # a tenth of the rows
    rise = describe_rise(late, np.r_[0.5 * error[:36], 2 * late[36:]], WORSE, WORST)
    assert re.fullmatch(r"mean of the worst 10% \d\S+ -> \d\S+", rise)
    assert describe_rise(error, 9 * late, RISES).startswith("mean ")


def test_gates_are_asked(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    session = measured(Model(SMALL), box(SMALL, 80, rng), rng)
    monkeypatch.setattr(plausible, "NO_NOISE", 1e-6)
    with few_effects(()), pytest.raises(JobError, match="more than noise"):
        la.diagnose(SMALL, session, network=False)
    monkeypatch.setattr(plausible, "INCREDIBLE", 0.0)
    with pytest.raises(JobError, match="not credible"):
        la.calibrate(SMALL, session, effects=["joint_gain"])
    monkeypatch.setattr(plausible, "WORSE", 0.0)
    with pytest.raises(JobError, match=r"worse on held-out rows.* \d\S+ -> \d\S+ mm"):
        la.calibrate(SMALL, session)
    monkeypatch.setattr(plausible, "WORSE", 9.0)
    monkeypatch.setattr(plausible, "RISES", 0.0)
    with pytest.raises(JobError, match=r"fails at held-out rows: mean \d\S+ -> \d\S+ mm"):
        la.calibrate(SMALL, session)


def test_stages_start_from_a_known_model(rng: np.random.Generator) -> None:
    """Geometry that a model holds is fitted once, not twice."""
    session = measured(Model(SMALL), box(SMALL, 60, rng), rng)
    first = dict(fit_stages(Model(SMALL), session))["geometry"].model
    again = dict(fit_stages(first, session))["geometry"].model
    assert [t.name for t in again.terms] == [t.name for t in first.terms]
    frame = next(e for e in again.effects if isinstance(e, BasePose)).base(SMALL)
    assert isinstance(frame, Frame)
