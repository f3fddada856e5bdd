"""What a diagnosis writes: never worse as commanded than calibration, and all of it in the file."""

import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from discover_rows import HELD_OUT, ROWS, calibrated, measured
from hidden_arm import session
from small_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.compensation.result import Prediction
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraDrift, CameraScale
from longarm_comp.core.effects.discovered import Discovered, DiscoveredView
from longarm_comp.core.effects.drive_errors import PrismaticPitch
from longarm_comp.core.effects.slow_changes import BaseSettling, ThermalGrowth
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify import diagnose as core
from longarm_comp.core.identify import diagnosis
from longarm_comp.core.identify.posterior.found import FoundEffect, PossibleCause
from longarm_comp.core.identify.proof import NETWORK, Fold, prove_models
from longarm_comp.core.identify.proved_models import choose_written
from longarm_comp.core.learn.predictor import LearnedGain
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, read_stored
from longarm_comp.report.record import parse_report, text
from longarm_comp.sim.hidden.geometry import JointZero
from longarm_comp.workflows.diagnose import DiagnosisResult, diagnose
from studies.outside import PumpShake, RubberStop

FAR = ARM.lower + 0.9 * (ARM.upper - ARM.lower)


def single(term: Any, there: float, *others: tuple[Any, float]) -> FoundEffect:
    own = (term, 1.0 - sum(p for _, p in others))
    each = (PossibleCause(Candidate(t.name, (t,)), 20.0, p) for t, p in (own, *others))
    return FoundEffect(tuple(each), there)


def test_rows_that_are_labelled_test_are_never_fitted() -> None:
    """Beside rows held out they were, in silence."""
    rows = measured(ARM, (), 60, 4)
    labelled = dataclasses.replace(rows, labels={"role": np.repeat(["train", "test"], 30)})
    with pytest.raises(InputError, match="role"):
        core.diagnose(ARM, labelled, test=measured(ARM, (), 30, 5), kinds=(PrismaticPitch,))


# ------------------------------------------------------------------ which model


def drifting(seed: int = 3) -> Session:
    """What is seen moves by 2.4 mm with time."""
    rows = measured(ARM, (), ROWS, seed)
    moved = np.outer(rows.columns["t_s"] / 1800.0, [1.2e-3, -1.6e-3, 1.3e-3])
    return dataclasses.replace(rows, xyz=rows.xyz + moved)


def test_what_a_camera_may_have_moved_is_a_commands_error_as_far_as_it_may_be_the_arms() -> None:
    """Sure that the camera drifts, a command errs by the noise; unsure, by what was seen."""
    plain = calibrated(ARM, drifting())
    camera = fit_model(plain.model.plus(CameraDrift()), plain.session, sigma=np.full(3, 2e-4))
    fits = {"calibrated": plain, "with_effects": camera}
    models = {name: fitted.model for name, fitted in fits.items()}
    proof = prove_models([Fold(models, fits, plain.session, np.arange(len(plain.session)))])
    (term,) = (b for b in camera.model.biases if isinstance(b, CameraDrift))
    ways = ((1.0,), (1.0, (BaseSettling(), 0.5)), (0.5,), (1.0, (CameraScale(), 0.5)))
    sure, unsure, absent, either = (
        proof.expected_errors([single(term, *how)], list(fits)) for how in ways
    )
    seen, told = ((e["with_effects"] ** 2).sum(1) for e in (proof.errors, proof.commanded))
    assert sure["with_effects"] == pytest.approx(np.sqrt(seen))
    assert unsure["with_effects"] == pytest.approx(np.sqrt(0.5 * seen + 0.5 * told))
    assert unsure["with_effects"].mean() > 1.5 * sure["with_effects"].mean()
    assert absent["with_effects"] == pytest.approx(unsure["with_effects"])
    assert either["with_effects"] == pytest.approx(sure["with_effects"])  # a camera, by any name
    nothing = proof.expected_errors([single(PrismaticPitch(3), 0.6)], list(fits))
    assert nothing["with_effects"] == pytest.approx(
        sure["with_effects"]
    )  # the arm's own effects move the tip, sure or not


def test_the_least_is_written_and_of_equals_the_plainer() -> None:
    names = ("calibrated", "with_effects", "with_functions")
    lengths = {name: np.full(9, size) for name, size in zip(names, (2.0, 1.0, 1.5), strict=True)}
    even = dict.fromkeys(names, np.ones(9))
    written, failed = choose_written(lengths, lengths, np.zeros(9))
    assert written == names[1] and failed.startswith("with_effects -> with_functions: ")
    assert choose_written(even, even, np.zeros(9)) == (names[0], "")
    assert choose_written(lengths, even, np.zeros(9)) == (names[1], ""), (
        "a doubt about the camera fails no proof"
    )


def test_a_model_to_which_nothing_was_added_is_the_calibrated_one() -> None:
    """A fold may add an effect; the fit to all rows is still that of the geometry alone."""
    found = diagnose(ARM, session(n=20, seed=8), network=False).diagnosis
    assert found.fits["with_effects"] is found.fits["calibrated"]
    assert found.written == "calibrated"
    nominal, calibrated = (found.proof.rows[k].mean_text for k in ("nominal", "calibrated"))
    assert f"{nominal} -> {calibrated}".replace(" mm ->", " ->") in found.summary


def test_gross_errors_do_not_hide_what_a_calibration_gains() -> None:
    rng = np.random.default_rng(3)
    rows = session((JointZero(np.array([3e-3, -4e-3, 2e-3, 4e-3])),), n=60, seed=2)
    xyz = rows.xyz.copy()
    xyz[rng.choice(60, 5, replace=False)] += rng.normal(0.0, 0.3, (5, 3))
    report = diagnose(ARM, dataclasses.replace(rows, xyz=xyz), network=False).report
    (before, after), _ = report.mean_errors
    assert after > 0.9 * before  # by the means of all rows nothing is gained
    assert report.written.believed_mm[1] < 0.2 * report.written.believed_mm[0]
    assert not report.nothing_gained
    said = "{:.2f} -> {:.2f} mm".format(*report.written.believed_mm)
    assert f"Held-out mean error (without the rows set aside) {said}" in report.summary


def test_rows_that_are_all_set_aside_all_count(monkeypatch: pytest.MonkeyPatch) -> None:
    some: Any = SimpleNamespace(
        fit=None, held_out=session(n=9), proof=SimpleNamespace(rows_at=np.arange(9))
    )
    for kept, counts in ((np.arange(9) == 4, 1), (np.zeros(9, dtype=bool), 9)):
        monkeypatch.setattr(diagnosis, "mark_believed_rows", lambda fit, rows, kept=kept: kept)
        assert diagnosis.Diagnosis.believed.func(some).sum() == counts


def test_a_thermal_term_balanced_by_the_measuring_side_is_not_written() -> None:
    """1 K of warmth; the camera's drift is that of the arm's growth, the other way round.

    As seen the pair is right and large.  A command with half of the pair would be 1 mm off.
    """
    rng = np.random.default_rng(2)
    rows = measured(ARM, (), ROWS, 3)
    t = np.linspace(0.0, 3600.0, ROWS)
    warm = ARM.reference_temperature_c + t / 3600.0
    rows = Session.record(rows.q, rows.xyz, columns={"t_s": t, "temperature_c": warm})
    growth = ThermalGrowth(expansion=2e-3)
    grown = Model(ARM, (growth,)).tip(rows.q, rows.context()) - Model(ARM).tip(rows.q)
    drift = np.outer(t / 3600.0, grown.mean(0) / (t.mean() / 3600.0))
    rows = dataclasses.replace(rows, xyz=rows.xyz + grown - drift)
    found = core.diagnose(ARM, rows, kinds=(ThermalGrowth, CameraDrift), seed=int(rng.integers(9)))
    means = {k: np.linalg.norm(v, axis=1).mean() for k, v in found.proof.commanded.items()}
    assert means[found.written] <= 1.02 * means["calibrated"]
    assert found.expected[found.written] == min(found.expected.values())
    assert found.model == found.models[found.written]


def test_what_no_command_is_told_does_not_shift_commands() -> None:
    """A sway of 1.4 to 4.4 mm with a pressure: without the pressure its mean stays known."""
    shake = (PumpShake(sway=9e-3, waves=0.2),)
    train, test = (measured(ARM, shake, n, s) for n, s in ((ROWS, 3), (HELD_OUT, 103)))
    found = core.diagnose(ARM, train, test=test, kinds=(PrismaticPitch,))
    assert found.causes[0].inputs == ("pump_bar",)
    assert found.causes[0].where == ("base, move x", "what is measured, x")
    assert "something that depends on the recorded column" in found.causes[0].reading
    assert not found.causes[0].compensated
    means = {k: np.linalg.norm(v, axis=1).mean() for k, v in found.proof.commanded.items()}
    assert means["with_functions"] < 1.1 * means["calibrated"]
    assert means[found.written] < 1.02 * means["calibrated"]
    assert found.left_out == (found.written != "with_functions")


def test_a_camera_that_moved_between_two_rows_has_moved_for_good() -> None:
    """The rows of a next session, numbered from 0 again, are all after it."""
    moved = DiscoveredView(
        "x", "switch(pose_number, 40.0, 0.5)", "pose_number 0.0..80.0", 1e-3, 5e-3
    )
    known = Model(ARM, (), (moved,))
    rows = measured(ARM, (), 60, 4)
    rows = dataclasses.replace(rows, columns={}, xyz=rows.xyz + 5e-3 * np.eye(3)[0])
    found = core.diagnose(ARM, rows, model=known, kinds=(PrismaticPitch,))
    assert "pose_number" not in found.train.columns
    assert found.proof.rows["calibrated"].mean < 1e-3


@dataclasses.dataclass(frozen=True)
class SaysAlways:
    """A predictor that says the same error everywhere, and that it helps."""

    error: tuple[float, float, float]
    gain = LearnedGain(low=1.0)

    def predict(self, q: np.ndarray, context: Context) -> Prediction:
        everywhere = np.tile(self.error, (len(q), 1))
        return Prediction(everywhere, everywhere, np.ones(len(q), bool), [""] * len(q))


@pytest.mark.parametrize(("share", "kept"), [(1.0, True), (0.0, False), (-1.0, False)])
def test_a_network_is_kept_where_held_out_rows_err_less(
    stopped: DiagnosisResult, share: float, kept: bool
) -> None:
    """It says a share of what the model leaves at these rows, on average."""
    d = stopped.diagnosis
    left = share * d.proof.errors[d.written].mean(axis=0)
    says: Any = SaysAlways((float(left[0]), float(left[1]), float(left[2])))
    network, proof = d.train_network(lambda model, rows: says)
    assert (network is says, NETWORK in proof.errors) == (kept, kept)


# ------------------------------------------------------------------ all of it is in the files


@pytest.fixture(scope="module")
def stopped() -> DiagnosisResult:
    """The stop of a joint, diagnosed without the library: none of its effects has such an end."""
    stop = (RubberStop(joint=1, begins=0.8, holds=0.1),)
    train, test = (measured(ARM, stop, n, s) for n, s in ((ROWS, 3), (HELD_OUT, 103)))
    kinds = (PrismaticPitch,)
    return DiagnosisResult(core.diagnose(ARM, train, test=test, kinds=kinds), train.hash, {})


def test_a_diagnosis_says_what_it_found_without_a_name(stopped: DiagnosisResult) -> None:
    found = stopped.diagnosis
    assert (found.verdict, found.findings) == ("partly", ())
    assert (found.written, found.left_out) == ("with_functions", False)
    (cause,) = found.causes
    (term,) = cause.effects
    (factor,) = term.of.factors  # type: ignore[union-attr]
    assert (factor.of, factor.word) == ("q2", "above")
    assert factor.threshold == pytest.approx(0.8, abs=0.02)
    assert abs(cause.amounts[0].value) == pytest.approx(0.1, rel=0.05)
    assert cause.sentence in stopped.summary
    assert "behaves like a contact, a stop or a taut cable" in stopped.summary
    assert found.none_of_these == pytest.approx(1.0)
    means = {k: np.linalg.norm(v, axis=1).mean() for k, v in found.proof.errors.items()}
    assert means["with_functions"] < 0.3 * means["calibrated"]
    assert means["with_effects"] == pytest.approx(means["calibrated"], rel=1e-6)
    parse_report(json.loads(text(stopped.report)))


def test_what_was_found_is_in_the_written_model(stopped: DiagnosisResult, tmp_path: Path) -> None:
    stopped.save(tmp_path)
    back = load_model(tmp_path / "model.yaml", ARM)
    np.testing.assert_array_equal(back.tip(FAR), stopped.model.tip(FAR))
    (term,) = (e for e in back.effects if isinstance(e, Discovered))
    (entry,) = (e for e in read_stored(tmp_path / "model.yaml").effects if e.effect == "discovered")
    low, high = entry.parameters["amount"].ci95 or (0.0, 0.0)
    assert low < term.amount < high
    assert low * high > 0.0


def test_an_explanation_without_a_name_takes_its_share_of_the_name() -> None:
    """Of odds of 1 to 4 a fifth, of its other names too; and what is there in its place gets it."""
    function = Discovered("joint 2", "turn z", "linear(q2)", "q2 0..1")
    found = single(CameraDrift(), 1.0, (function, 0.1), (BaseSettling(), 0.3))
    other = single(function, 1.0)
    doubted = found.add_rival(other, math.log(0.25))
    assert doubted.names == pytest.approx(
        {"camera_drift": 0.48, "base_settling": 0.24, "discovered": 0.28}
    )
    assert [r.name for r in doubted.rivals] == ["discovered", "base_settling"]
    assert sum(doubted.names.values()) == pytest.approx(1.0)
    new = single(CameraDrift(), 1.0).add_rival(other, 0.0)
    assert new.names == pytest.approx({"camera_drift": 0.5, "discovered": 0.5})
