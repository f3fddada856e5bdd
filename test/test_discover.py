"""What the library lacks is found: place, component and function, proven or left alone."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from discover_rows import DEMO, HELD_OUT, ROWS, calibrated, measured
from small_arm import ARM as SMALL

from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import load_file
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.function import Function
from longarm_comp.core.effects.prismatic_pitch import PrismaticPitch
from longarm_comp.core.effects.shapes import Legendre, Linear, Square, Switch
from longarm_comp.core.errors import JobError
from longarm_comp.core.identify import diagnose as core
from longarm_comp.core.identify.discover.bank import Hypothesis, Spot
from longarm_comp.core.identify.discover.banks import sides
from longarm_comp.core.identify.discover.discovery import (
    Discovery,
    discover,
)
from longarm_comp.core.identify.discover.functions import SWITCH, Functions, switch
from longarm_comp.core.identify.discover.hold_out import borne_out, shown
from longarm_comp.core.identify.discover.inputs import Argument, Arguments, levels_of
from longarm_comp.core.identify.discover.propose import POSES, doubts, proposed
from longarm_comp.core.identify.discover.search import first, search
from longarm_comp.core.identify.discover.set_aside import shared
from longarm_comp.core.identify.discover.terms import refitted
from longarm_comp.core.identify.proof import Proof, prove
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, read_stored
from longarm_comp.report.record import checked
from longarm_comp.sim.hidden import loads
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.workflows.diagnose import DiagnosisResult
from longarm_comp.workflows.diagnosis_files import write_model
from longarm_comp.workflows.effect_file import write_effects
from studies.outside import HosePull, PumpShake, RubberStop, TwoSeats


def look(arm_name: str, *hidden: HiddenEffect, seed: int = 3) -> Discovery | None:
    arm = {"small": SMALL, "demo": DEMO}[arm_name]
    fitted = calibrated(arm, measured(arm, hidden, ROWS, seed))
    held_out = measured(arm, hidden, HELD_OUT, seed + 100)
    return discover(fitted, None, 100, lambda: held_out, None, np.random.default_rng(0))


found = cache(look)


def test_a_hose_is_a_force_at_its_place_with_its_size() -> None:
    made = found("demo", HosePull(row=5, first=1, second=4, pull=24.0))
    assert made is not None
    assert made.kept
    (cause,) = made.found
    assert cause.where[0] == "joint 5, force y"
    assert cause.terms[0].function == "linear(q2) * linear(q5)"
    (amount,) = cause.amounts
    assert amount.unit == "N/rad^2"
    assert amount.ci95[0] < 24.5
    assert amount.ci95[1] > 23.5
    assert "N/rad^2 x q2 x q5" in cause.sentence
    assert "behaves like a hose or cable that pulls" in cause.sentence
    assert cause.compensated
    rows = made.proof.rows
    assert rows["with_effects"].rms < 0.5 * rows["calibrated"].rms


@pytest.mark.parametrize(
    ("hidden", "where", "size", "reading"),
    [
        (loads.LinkMass(row=6, mass_kg=0.5), "joint 6, weight", 4.9, "a mass that is not declared"),
        (loads.BearingTilt(np.eye(7)[1] * 6e-3), "joint 2, give", 6e-3, "something that gives"),
    ],
)
def test_a_weight_and_what_gives_are_one_number(
    hidden: HiddenEffect, where: str, size: float, reading: str
) -> None:
    made = look("demo", hidden)
    assert made is not None
    assert made.kept
    (cause,) = made.found
    assert where in cause.where
    assert cause.terms[0].function == "1"
    assert cause.amounts[0].value == pytest.approx(size, rel=0.1)
    assert f"behaves like {reading}" in cause.sentence


def test_a_fit_that_runs_away_leaves_its_function_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The diagnosis goes on without it."""
    hose = (HosePull(row=5, first=1, second=4, pull=24.0),)
    fitted = calibrated(DEMO, measured(DEMO, hose, ROWS, 3))
    tried: list[int] = []

    def run_away(model: Model, *args: Any) -> Any:
        count = sum(isinstance(term, Discovered) for term in model.terms)
        if count:
            tried.append(count)
            raise JobError("the fit did not stay finite")
        return refitted(model, *args)

    monkeypatch.setattr("longarm_comp.core.identify.discover.search.refitted", run_away)
    assert search(fitted, None) is None
    assert first(fitted, None) is None
    assert tried == [1, 1]


def test_a_scale_of_the_camera_is_one_number() -> None:
    """Slides with a wrong pitch move the tip alike; of what a command does they say otherwise."""
    rows, held_out = (measured(DEMO, (), n, seed) for n, seed in ((ROWS, 3), (HELD_OUT, 103)))
    assert DEMO.camera is not None
    rows, held_out = (
        dataclasses.replace(s, xyz=s.xyz + 0.004 * (s.xyz - DEMO.camera.position_m))
        for s in (rows, held_out)
    )
    plain = calibrated(DEMO, rows)
    made = discover(plain, None, 100, lambda: held_out, None, np.random.default_rng(0))
    assert made is not None
    (cause,) = made.found
    assert cause.where[0] == "what the camera sees, distance"
    assert not cause.compensated
    assert cause.amounts[0].value == pytest.approx(0.004, rel=0.15)
    assert cause.formula.startswith("what the camera sees, distance: (0.00")
    assert cause.formula.endswith(")")


def test_a_few_poses_that_cannot_decide_do_not_overrule_the_fitted_ones() -> None:
    """A weak hose, sure by the fitted rows; another arm's poses refute it all the same."""
    rng = np.random.default_rng(0)
    hose = (HosePull(row=5, first=1, second=4, pull=10.0),)
    fitted = calibrated(DEMO, measured(DEMO, hose, 2 * ROWS, 1))
    made = discover(fitted, None, 100, lambda: measured(DEMO, hose, 30, 503), None, rng)
    assert made is not None
    assert made.kept
    assert not shown(made.proof)
    assert "too few to show it" in made.sentence
    assert made.found[0].terms[0].function == "linear(q2) * linear(q5)"
    models = {"calibrated": fitted.model, "with_effects": made.fit.model}
    other = prove(models, fitted, made.fit, measured(DEMO, (), 30, 501), rng)
    assert not borne_out(other, made.found[0].log_evidence)


@pytest.mark.parametrize(
    ("evidence", "log_odds", "after", "rho", "kept"),
    [
        (80.0, 0.5, 0.9, 0.0, True),
        (60.0, 0.5, 0.9, 0.0, False),
        (60.0, 1.5, 0.9, 0.0, True),
        (80.0, 0.5, 0.9, 0.3, False),
        (80.0, 0.5, 1.1, 0.0, False),
        (900.0, -2.5, 0.9, 0.0, True),
        (900.0, -3.5, 0.9, 0.0, False),
    ],
)
def test_strong_evidence_needs_a_hold_out_that_agrees(
    evidence: float, log_odds: float, after: float, rho: float, kept: bool
) -> None:
    before = np.tile([1e-3, 0.0, 0.0], (8, 1))
    errors = {"calibrated": before, "with_effects": after * before}
    proof = Proof(errors, errors, {}, False, 1.0, 0.0, 1.0, log_odds=log_odds)
    assert not shown(proof)
    assert borne_out(proof, evidence, rho) is kept


def test_a_recorded_column_that_drives_the_error_is_found_on_its_axis() -> None:
    made = found("small", PumpShake(sway=2e-3, waves=6.0))
    assert made is not None
    assert made.kept
    (cause,) = made.found
    assert {f.of for t in cause.terms for f in t.of.factors} == {"pump_bar"}
    assert all(w.endswith(" x") for w in {a.where for a in cause.amounts})
    assert "something that the recorded column drives" in cause.reading


def test_what_no_command_is_told_does_not_shift_commands() -> None:
    """A sway of 1.4 to 4.4 mm with the pressure: without the pressure its mean stays known."""
    made = found("small", PumpShake(sway=9e-3, waves=0.2))
    assert made is not None
    assert made.kept
    before, after = (
        np.linalg.norm(made.proof.commanded[k], axis=1).mean()
        for k in ("calibrated", "with_effects")
    )
    assert after < 1.1 * before


# ------------------------------------------------------------------ rows set aside


def spoilt(rows: Session, seed: int, share: float = 0.02) -> tuple[Session, np.ndarray]:
    """With gross errors of 3 to 15 mm in some rows, and which these are."""
    rng = np.random.default_rng(seed)
    bad = rng.random(len(rows)) < share
    way = rng.standard_normal((len(rows), 3))
    way *= rng.uniform(3e-3, 15e-3, (len(rows), 1)) / np.linalg.norm(way, axis=1, keepdims=True)
    return dataclasses.replace(rows, xyz=rows.xyz + bad[:, None] * way), bad


def test_seats_that_flip_in_few_rows_are_no_outliers() -> None:
    """In 7 of 240, beside 7 true outliers; 80 poses to hold out do not show it alone."""
    seats = (TwoSeats(row=7, axis=1, angle=4e-3, flips_at=-1.085),)
    rows, bad = spoilt(measured(DEMO, seats, 2 * ROWS, 3), 903)
    held_out, _ = spoilt(measured(DEMO, seats, 80, 103), 1003)
    fitted = calibrated(DEMO, rows)
    assert (fitted.weights == 0).sum() == bad.sum() + 7
    made = discover(fitted, None, 100, lambda: held_out, None, np.random.default_rng(0))
    assert made is not None
    assert made.kept
    (cause,) = made.found
    assert "sign(load_6 - -1.1" in cause.formula
    assert "joint 7, turn y" in cause.where
    np.testing.assert_array_equal(made.fit.weights == 0, bad)
    assert not shown(made.proof)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("share", [0.02, 0.12])
def test_outliers_share_no_displacement(seed: int, share: float) -> None:
    fitted = calibrated(SMALL, spoilt(measured(SMALL, (), ROWS, 3), seed, share)[0])
    assert shared(fitted, sides(fitted)) is None


@pytest.mark.parametrize("seed", range(3))
def test_where_nothing_is_hidden_nothing_is_found(seed: int) -> None:
    made = found("small", seed=seed)
    assert made is None or not made.kept


# ------------------------------------------------------------------ in a diagnosis


@pytest.fixture(scope="module")
def diagnosed() -> DiagnosisResult:
    """The stop of a joint, diagnosed without the library: none of its effects has such an end."""
    stop = (RubberStop(joint=1, begins=0.8, holds=0.1),)
    train, test = (measured(SMALL, stop, n, s) for n, s in ((ROWS, 3), (HELD_OUT, 103)))
    kinds = (PrismaticPitch,)
    return DiagnosisResult(core.diagnose(SMALL, train, test=test, kinds=kinds), train.hash, {})


def test_a_diagnosis_adds_what_it_found_and_says_so(diagnosed: DiagnosisResult) -> None:
    assert diagnosed.verdict == "unknown"
    assert not diagnosed.findings
    added = diagnosed.diagnosis.added
    assert added is not None
    (factor,) = added.found[0].terms[0].of.factors
    assert (factor.of, factor.word) == ("q2", "above")
    assert factor.threshold == pytest.approx(0.8, abs=0.05)
    assert added.found[0].sentence in diagnosed.summary
    assert "behaves like a contact, a stop or a taut cable" in diagnosed.summary
    assert len(diagnosed.diagnosis.holdout_uses) == 2
    rows = diagnosed.report()["held_out"]["rows"]
    mean = {row["model"]: row["mean_mm"] for row in rows}
    assert mean["with_discovered"] < 0.7 * mean["calibrated"]
    (told,) = diagnosed.report()["discovered"]
    assert told["kept"]
    assert told["compensated"]
    assert told["domain"][0].startswith("q2 0.")
    checked(diagnosed.report())


def test_what_was_found_is_in_the_written_model(diagnosed: DiagnosisResult, tmp_path: Path) -> None:
    write_model(diagnosed.diagnosis, diagnosed.model, "0" * 64, None, tmp_path, None)
    back = load_model(tmp_path / "model.yaml", SMALL)
    q = SMALL.lower + 0.9 * (SMALL.upper - SMALL.lower)
    np.testing.assert_array_equal(back.tip(q), diagnosed.model.tip(q))
    (term,) = (e for e in back.effects if isinstance(e, Discovered))
    stored = read_stored(tmp_path / "model.yaml").effects
    (entry,) = (e for e in stored if e.effect == "discovered")
    low, high = entry.parameters["amount"].ci95 or (0.0, 0.0)
    assert low < term.amount < high
    assert entry.origin.startswith("unknown, session 0000")


@pytest.mark.usefixtures("catalogue_of_ours")
def test_what_was_found_is_written_as_an_effect_of_a_library(
    diagnosed: DiagnosisResult, tmp_path: Path
) -> None:
    path = tmp_path / "found.py"
    write_effects(diagnosed.diagnosis, path)
    (kind,) = load_file(path)
    (term,) = (e for e in diagnosed.model.effects if isinstance(e, Discovered))
    ((made,),) = kind.candidates(SMALL)
    q = SMALL.lower + 0.9 * (SMALL.upper - SMALL.lower)
    alone = Model(SMALL, (term,)).tip(q)
    np.testing.assert_array_equal(
        Model(SMALL, (made.with_values({"amount_1": term.amount}),)).tip(q), alone
    )
    assert np.abs(alone - Model(SMALL).tip(q)).max() > 1e-4


def test_there_is_no_effect_to_write_where_nothing_was_found(
    diagnosed: DiagnosisResult, tmp_path: Path
) -> None:
    nothing = dataclasses.replace(diagnosed.diagnosis, discovery=None)
    with pytest.raises(JobError, match="nothing was found"):
        write_effects(nothing, tmp_path / "found.py")


def test_what_a_column_drives_on_one_axis_is_no_noise() -> None:
    """140 rows, x alone off by 4 mm x sin(6 pump_bar): beside it the noise is 0.2 mm."""
    shake = (PumpShake(sway=4e-3, waves=6.0),)
    session = measured(SMALL, shake, 140, 5)
    result = core.diagnose(SMALL, session, kinds=(PrismaticPitch,))
    assert result.verdict == "unknown"
    assert result.added is not None
    assert result.added.inputs == ("pump_bar",)
    assert result.structure.inputs
    assert result.added.found[0].where[1] == "what the camera sees, x"


# ------------------------------------------------------------------ what the data cannot tell


def test_of_three_positions_only_lines_are_tried() -> None:
    three, many = np.tile([0.0, 0.5, 1.0], 20), np.linspace(-1.0, 1.0, 60)
    of = (Argument("q1", three, levels_of(three)), Argument("q2", many, levels_of(many)))
    made = Functions(Arguments(of, (), 2))
    shapes = {factor for function in made.listed for factor in function.factors}
    assert {type(s) for s in shapes if s.of == "q2"} > {Linear, Legendre, Switch, Square}
    flat = [s for s in shapes if s.of == "q1"]
    assert {type(s) for s in flat} == {Linear, Legendre}
    assert {s.order for s in flat if isinstance(s, Legendre)} == {1}


def test_poses_lie_in_the_gap_of_a_switch() -> None:
    fitted = calibrated(SMALL, measured(SMALL, (), 40, 1))
    flip = Function((Switch("q2", 0.2, 1.2, 0.7, 0.05),))
    guess = Hypothesis(((Spot("joint 2", "turn z"), flip),), (1.0,), SWITCH, 0.0)
    assert doubts(fitted, [guess]) == ("it changes over somewhere between q2 0.65 and 0.75",)
    poses = proposed(fitted, [guess], seed=1)
    assert len(poses) == POSES
    assert (np.abs(poses[:, 1] - 0.7) < 0.05).all()
    smooth = Hypothesis(((Spot("joint 2", "turn z"), Function(())),), (1.0,), SWITCH, 0.0)
    assert doubts(fitted, [smooth]) == ()
    assert proposed(fitted, [smooth], seed=1).shape == (0, SMALL.n)


def test_a_ramp_fills_the_gap_of_the_data() -> None:
    values = np.array([0.0, 0.1, 0.2, 0.6, 0.7, 1.0])
    made = switch(Argument("q1", values, 6), 0.3)
    assert (made.threshold, made.half) == pytest.approx((0.4, 0.2))
    np.testing.assert_allclose(made.at(values), [-1, -1, -1, 1, 1, 1], atol=1e-12)
    assert float(made.at(0.4)) == pytest.approx(0.0)
