"""How good a model says that it is, against rows and tips that it has not seen."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from hidden_arm import SIGMA, at, calibrated, session, tip
from read_arm import ARM as HEAVY
from small_arm import ARM

import longarm_comp.core.calibration.uncertainty as uncertainties
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import LEGS, Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.left_out import LeftOut
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.uncertainty import (
    estimate_arm_share,
    measure_uncertainty,
    with_uncertainty,
)
from longarm_comp.core.compensation.compensate import compensate, judge
from longarm_comp.core.compensation.expected import expected_miss, list_tolerances
from longarm_comp.core.compensation.result import Method, Prediction, Status
from longarm_comp.core.compensation.weighing import SD
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraRadial
from longarm_comp.core.effects.drive_errors import JointGain as Gain
from longarm_comp.core.effects.masses import TipPayload
from longarm_comp.core.effects.plays import FrictionHysteresis
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.domain import least_moved
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, save_model, store
from longarm_comp.core.model.uncertainty import (
    ModelUncertainty,
    sizes,
)
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.drives import JointGain
from longarm_comp.sim.hidden.geometry import JointZero
from longarm_comp.sim.hidden.loads import JointCompliance

ZEROS = JointZero(at(1, 0.003) + at(2, -0.004))
LACKING = JointGain(at(2, 0.03))
FAR = np.array([4.0, 1.0, -0.3])  # m, the base in the frame of the measurements


@cache
def zeroed(n: int, lacking: bool = False) -> ModelFit:
    """The geometry fitted to rows of an arm whose zeros are off, and what the fit lacks."""
    return calibrated(session([ZEROS, LACKING] if lacking else [ZEROS], n=n))


def fresh(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q = ARM.lower + rng.random((n, ARM.n)) * (ARM.upper - ARM.lower)
    return q, rng.choice([-1.0, 1.0], n)


@pytest.mark.parametrize("hidden", [[ZEROS], [ZEROS, LACKING]], ids=["known", "lacking"])
def test_ninety_of_a_hundred_rows_and_tips_lie_inside(hidden: list) -> None:
    """Over several sessions, as each alone may be lucky."""
    rows_inside, tips_inside, stated, true = [], [], [], []
    for seed in range(4):
        fitted = calibrated(session(hidden, n=120, seed=seed))
        known = measure_uncertainty(fitted)
        q, side = fresh(100, 100 + seed)
        context = Context(approach=tuple(np.repeat(side[None], ARM.n, axis=0)))
        truth = tip(hidden, q, side)
        noise = SIGMA * np.random.default_rng(seed).standard_normal(truth.shape)
        at_rows = fitted.model.posture(tuple(q.T), context)
        columns = fitted.model.columns(at_rows)[1]
        carried = known.carry_to_tip(columns, [slot.identity for slot in fitted.slots])
        off = truth - fitted.model.tip(q, context)
        structure = known.structure_at(q, least_moved(ARM))
        expected, within = sizes(carried + structure)
        tips_inside += list(np.linalg.norm(off, axis=1) <= within)
        rows = sizes(carried + structure + known.noise)[1]
        rows_inside += list(np.linalg.norm(off + noise, axis=1) <= rows)
        stated.append(expected.mean())
        true.append(np.linalg.norm(off, axis=1).mean())
    assert 0.86 <= np.mean(rows_inside) <= 0.98
    assert np.mean(tips_inside) >= 0.85
    assert np.mean(true) < 1.1 * np.mean(stated) and np.mean(stated) < 3.0 * np.mean(true)


def test_rows_that_count_as_one_leave_the_parameters_less_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(uncertainties, "possible_compliances", lambda arm, held: ())
    fitted, spread = zeroed(60), []
    for alike in (1.0, 9.0):
        monkeypatch.setattr(
            LeftOut, "find_least_errors", lambda self, noise, n=alike: (n, np.zeros((3, 3)))
        )
        factor = measure_uncertainty(fitted).factor
        spread.append(np.linalg.norm(fitted.columns[:, :3] @ factor, axis=(1, 2)))
    assert np.median(spread[1] / spread[0]) == pytest.approx(3.0, rel=0.1)


def test_a_few_large_errors_are_no_noise() -> None:
    """Where the arm errs, the tip does: as noise, they would make the promise of all rows less."""
    fitted = zeroed(120)
    residual, records = fitted.residual.copy(), []
    for off in (0.0, 12.0 * SIGMA):
        residual[::40, :3] += off
        records.append(measure_uncertainty(dataclasses.replace(fitted, residual=residual)))
    plain, with_errors = (np.sqrt(np.trace(each.noise) / 3.0) for each in records)
    assert 0.8 * SIGMA < plain < 1.1 * SIGMA and with_errors < 1.1 * plain


LUFFS = (1, 2)  # 0-based joints of the heavy arm that its weight turns
WEAK = tuple(4e-4 if j in LUFFS else 0.0 for j in range(HEAVY.n))


@pytest.mark.parametrize("weak", [WEAK, (0.0,) * HEAVY.n], ids=["soft", "rigid"])
def test_joints_that_went_together_do_not_tell_what_yields(
    weak: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All rows on one line of the joint space: elsewhere the geometry may be sag."""
    rng, span = np.random.default_rng(3), HEAVY.upper - HEAVY.lower
    true = TrueArm(HEAVY, (JointCompliance(np.array(weak)),))
    line = HEAVY.lower + (0.05 + 0.9 * rng.random((100, 1))) * span
    wide = HEAVY.lower + rng.random((100, HEAVY.n)) * span
    commands = HEAVY.lower + rng.random((100, HEAVY.n)) * span
    times = []
    for q in (line, wide):
        seen = true.tip(q) + SIGMA * rng.standard_normal((100, 3))
        *_, (_, fitted) = fit_stages(declared_model(HEAVY), Session.record(q, seen + FAR))
        tips = fitted.model.tip(commands, Context())
        with monkeypatch.context() as patch:
            patch.setattr(uncertainties, "possible_compliances", lambda arm, held: ())
            fewer = with_uncertainty(fitted)
        promised, without = (
            expected_miss(model, commands, Context(), tips).sizes[1]
            for model in (with_uncertainty(fitted), fewer)
        )
        off = fitted.model.measured(commands, Context()) - FAR - true.tip(commands)
        assert (np.linalg.norm(off, axis=1) <= promised).mean() > 0.85
        times.append(np.median(promised) / np.median(without))
        assert fewer.uncertainty is not None
        assert (
            all(t.elastic for t in measure_uncertainty(fitted).absent)
            and not fewer.uncertainty.absent
        )
    assert times[0] > 1.25 and times[1] < 1.4


def test_noise_is_told_from_what_the_arm_does() -> None:
    assert estimate_arm_share(zeroed(150)) < 0.15
    assert estimate_arm_share(zeroed(150, lacking=True)) > 0.5


def test_the_noise_of_a_heavy_arm_whose_joints_yield() -> None:
    """Wherever it stands: an unknown base says nothing of its joints."""
    rng = np.random.default_rng(5)
    q = HEAVY.lower + (HEAVY.upper - HEAVY.lower) * rng.random((250, HEAVY.n))
    soft = JointCompliance(np.array([0.0, 4e-4, 4e-4, 0.0]))
    seen = TrueArm(HEAVY, (soft,)).tip(q) + SIGMA * rng.standard_normal((250, 3))
    *_, (_, fitted) = fit_stages(declared_model(HEAVY), Session.record(q, seen + FAR))
    left = np.sqrt((fitted.residual**2).mean())
    assert left > 1.5 * SIGMA
    assert np.sqrt(np.trace(measure_uncertainty(fitted).noise) / 3) == pytest.approx(
        SIGMA, rel=0.25
    )


def test_few_repeats_count_too() -> None:
    """Rows that the geometry cannot explain, but whose repeats scatter as much: noise."""
    rows = session([ZEROS], n=60)
    twice = np.tile(rows.q[:6], (2, 1))
    rng = np.random.default_rng(3)
    scatter = 5.0 * SIGMA * rng.standard_normal((12, 3))
    q = np.concatenate([rows.q, twice])
    xyz = np.concatenate(
        [rows.xyz, np.tile(tip([ZEROS], rows.q[:6], np.ones(6)), (2, 1)) + scatter]
    )
    alone = estimate_arm_share(zeroed(60, lacking=True))
    quiet = estimate_arm_share(calibrated(Session.record(q, xyz)))
    assert quiet < 0.5 * alone


def test_far_from_the_rows_the_error_grows() -> None:
    rows = session([ZEROS], n=200)
    near = rows.take(rows.q[:, 0] < ARM.lower[0] + 0.25 * (ARM.upper - ARM.lower)[0])
    model = with_uncertainty(calibrated(near))
    q = np.tile(ARM.mid, (2, 1))
    q[:, 0] = ARM.lower[0], ARM.upper[0]
    here, there = (
        expected_miss(model, joints, Context(), model.tip(joints)).sizes[0] for joints in q
    )
    assert there > 1.5 * here


@pytest.mark.parametrize("learned", [False, True])
def test_many_commands_are_judged_as_each_alone(learned: bool) -> None:
    fitted = with_uncertainty(zeroed(60))
    model = fitted.plus(FrictionHysteresis(2, far=0.1, width=0.01, outer=0.01), TipPayload(0.1))
    model = dataclasses.replace(model, uncertainty=fitted.uncertainty)
    q, side = fresh(4, seed=3)
    way = History(np.tile(side[:, None], ARM.n), np.zeros((4, ARM.n, LEGS)), np.zeros((4, ARM.n)))
    way.legs[2:, 1, 0] = 0.05, 1.0  # not known, little of it, all of it
    told = {SD: np.array([0.0, 0.05, 0.0, 0.1]), "payload_kg": np.array([0.1, 0.2, 0.3, 0.4])}
    context = Context(**way.fields(), columns=told)
    pseudo = model.tip(q, context) + 1e-3 * side[:, None]
    sigma = 1e-3 * (1.0 + q[:, :3] ** 2) if learned else None
    whole, inside, doubts = judge(model, Method.BOTH, q, context, pseudo, sigma)
    for k in range(4):
        alone, its, (doubt,) = judge(
            model, Method.BOTH, q[k], context.take(k), pseudo[k],
            None if sigma is None else sigma[k],
        )  # fmt: skip
        assert doubts[k] == doubt and inside[k] == its
        np.testing.assert_allclose(whole.mean[k], alone.mean, atol=1e-9)
        np.testing.assert_allclose(whole.covariance[k], alone.covariance, rtol=1e-6, atol=1e-15)
        assert whole.sizes[1][k] == pytest.approx(alone.sizes[1], rel=1e-6)
    assert [("payload" in doubt) for doubt in doubts] == [False, True, False, True]
    assert [("earlier moves" in doubt) for doubt in doubts] == [True, True, True, False]


def test_the_file_says_what_the_model_says(tmp_path: Path) -> None:
    rows = session([ZEROS], n=60)
    fitted = calibrated(rows)
    made = fitted.model.plus(TipPayload())  # another order of terms than in the file
    made = with_uncertainty(fit_model(made, rows))
    save_model(tmp_path / "model.yaml", store(made))
    back = load_model(tmp_path / "model.yaml", ARM)
    for model in (back, load_model(tmp_path / "model.yaml", ARM)):
        target = model.tip(ARM.mid) + 1e-3
        mine, theirs = (expected_miss(m, ARM.mid, Context(), target) for m in (made, model))
        np.testing.assert_allclose(theirs.sizes, mine.sizes, rtol=1e-4)
    assert (tmp_path / "model.yaml").stat().st_size < 40_000


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda u: u["factor"].pop(), "lines"),
        (lambda u: u["factor"].__setitem__(1, "AAAA"), "line 2"),
        (lambda u: u["factor"].__setitem__(0, "not base 64"), "line 1"),
        (lambda u: u["factor"].__setitem__(0, "AADAfw=="), "line 1"),  # NaN
        (lambda u: u["structure_m2"][0].__setitem__(0, -1.0), "structure_m2"),
        (lambda u: u.__setitem__("stretch", 1.0), "stretch"),  # of a version before
        (lambda u: u["absent"].append({"effect": "camera_scale", "where": ""}), "of the arm"),
        (lambda u: u["absent"].append(u["absent"][0]), "each once, in order"),
        (lambda u: u["absent"].reverse(), "another order"),
        (lambda u: u["absent"][0]["form"].update(joint=9), "joint"),
    ],
)
def test_a_damaged_record_is_refused(tmp_path: Path, change, said: str) -> None:
    path = tmp_path / "model.yaml"
    save_model(path, store(with_uncertainty(zeroed(40))))
    data = yaml.safe_load(path.read_text())
    change(data["uncertainty"])
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match=said):
        load_model(path, ARM)


def test_another_fit_forgets_what_was_known() -> None:
    rows = session([ZEROS], n=40)
    known = with_uncertainty(calibrated(rows))
    assert known.uncertainty is not None
    assert fit_model(known, rows).model.uncertainty is None


def test_the_arm_as_declared_goes_by_its_tolerances() -> None:
    model = Model(ARM)
    found = compensate(model, None, model.tip(ARM.mid), method=Method.DEFLECTION)[0]
    assert found.status is Status.SUCCESS
    assert 2e-3 < found.expected_m < found.p90_m < 2e-2
    assert np.isfinite(found.sigma).all()
    tight = {"tip": {"xyz_m": 0.05}}
    loose = ARM.model_validate({**ARM.model_dump(exclude_defaults=True), "tolerance": tight})
    more = compensate(Model(loose), None, model.tip(ARM.mid), method=Method.DEFLECTION)[0]
    assert more.expected_m > 2.0 * found.expected_m


def test_before_any_calibration_zeros_by_hand_and_joints_that_yield_are_expected() -> None:
    rng = np.random.default_rng(5)
    model, inside, off, expected = declared_model(HEAVY), [], [], []
    for _ in range(40):
        zeros = JointZero(rng.normal(0.0, np.radians(1.0), HEAVY.n))
        yields = JointCompliance(rng.uniform(0.0, 5e-3, HEAVY.n))  # up to 2 degrees
        q = rng.uniform(HEAVY.lower, HEAVY.upper, (8, HEAVY.n))
        off.append(np.linalg.norm(TrueArm(HEAVY, (zeros, yields)).tip(q) - model.tip(q), axis=1))
        doubt = expected_miss(model, q, Context(), model.tip(q))
        inside.append(off[-1] <= doubt.sizes[1])
        expected.append(doubt.sizes[0])
    assert np.mean(inside) >= 0.85
    assert np.mean(expected) < 1.5 * np.mean(off)  # and not by promising nothing


def test_a_tolerance_that_is_given_holds_for_the_zeros() -> None:
    given = ARM.model_dump(exclude_defaults=True)
    tight = {"theta_deg": 0.05}
    given["joints"] = [{**joint, "tolerance": tight} for joint in given["joints"]]
    q, _ = fresh(20, 1)
    by_hand, measured = (
        expected_miss(model, q, Context(), model.tip(q)).sizes[0]
        for model in (declared_model(ARM), declared_model(ARM.model_validate(given)))
    )
    assert (measured < 0.7 * by_hand).all()


def test_what_the_camera_does_moves_no_tip(demo_arm_path: Path) -> None:
    arm = Arm.load(demo_arm_path)
    model = declared_model(arm).plus(*CameraRadial.for_arm(arm), *Gain.for_arm(arm)[:1])
    names = tuple(slot.identity for slot in model.slots)
    none, q = np.zeros((3, 3)), arm.mid[None] + 0.1
    misses = []
    for of_camera in (0.0, 1.0):
        sizes_of = [of_camera if isinstance(s.owner, CameraRadial) else 1e-3 for s in model.slots]
        known = ModelUncertainty(names, np.diag(sizes_of), none, none, 1.0, 50)
        judged_by = dataclasses.replace(model, uncertainty=known)
        misses.append(expected_miss(judged_by, q, Context(), model.tip(q)).sizes[0])
    assert (misses[0] > 0).all()
    np.testing.assert_array_equal(misses[0], misses[1])


def test_nothing_is_said_of_a_model_without_a_record() -> None:
    fitted = zeroed(40)
    assert list_tolerances(fitted.model) is None
    found = compensate(fitted.model, None, fitted.model.tip(ARM.mid), method=Method.DEFLECTION)[0]
    assert found.status is Status.SUCCESS and np.isnan(found.expected_m)


@dataclasses.dataclass
class Says:
    """A predictor that answers alike everywhere, inside its data or not."""

    inside: bool
    sigma: float = 1e-3

    def predict(self, q, context=None):
        n = len(q)
        sigma, inside = np.full((n, 3), self.sigma), np.full(n, self.inside)
        return Prediction(np.full((n, 3), 1e-4), sigma, inside)


def test_outside_a_predictor_s_data_good_physics_is_a_success() -> None:
    good = with_uncertainty(zeroed(120))
    target = good.tip(ARM.mid)
    found = compensate(good, Says(inside=False), target)[0]
    assert found.status is Status.SUCCESS
    assert "physics only" in found.reason and not found.in_domain
    assert not found.predicted_error.any()
    assert (
        found.expected_m == compensate(good, None, target, method=Method.DEFLECTION)[0].expected_m
    )
    known = good.uncertainty
    assert known is not None
    far = dataclasses.replace(good, uncertainty=dataclasses.replace(known, largest_m=1e-9))
    assert compensate(far, Says(inside=False), target)[0].status is Status.OUT_OF_DOMAIN
    bare = dataclasses.replace(good, uncertainty=None)
    assert compensate(bare, Says(inside=False), target)[0].status is Status.OUT_OF_DOMAIN


def test_a_predictor_s_sigma_counts_without_the_noise_of_a_measurement() -> None:
    good = with_uncertainty(zeroed(120))
    known = good.uncertainty
    assert known is not None
    target = good.tip(ARM.mid)
    found = compensate(good, Says(inside=True), target)[0]
    wanted = np.sqrt(1e-6 - np.diag(known.noise) + np.diag(known.frame))
    np.testing.assert_allclose(found.sigma, wanted, rtol=1e-6)
    sure = compensate(good, Says(inside=True, sigma=1e-6), target)[0]
    alone = compensate(good, None, target, method=Method.DEFLECTION)[0]
    assert 0.0 < sure.expected_m <= 1.2 * alone.expected_m


def test_what_a_method_leaves_out_is_expected_at_the_target() -> None:
    """Without the physics of the model, its own error is known and stated."""
    bent = with_uncertainty(zeroed(60)).plus(Gain(joint=2, gain=0.03))
    target = bent.tip(ARM.mid)
    found = compensate(bent, None, target, method=Method.NONE)[0]
    missed = np.linalg.norm(bent.tip(found.command) - target)
    assert missed > 1e-3
    assert found.expected_m == pytest.approx(missed, rel=0.1)
