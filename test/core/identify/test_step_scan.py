"""Servo steps of a size that nobody declared: found, and paid for."""

import math
from pathlib import Path

import numpy as np
import pytest
from hidden_arm import SIGMA, at, session, tip
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import declared_model
from longarm_comp.core.calibration.candidates import Candidate, list_candidates
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import searched_effects
from longarm_comp.core.effects.drive_errors import JointGain, ServoQuantisation
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.identify.posterior.explained import ExplainedSession
from longarm_comp.core.identify.posterior.offers import evidence_of_each
from longarm_comp.core.model.model_file import load_model, save_model, store
from longarm_comp.sim.hidden import drives
from longarm_comp.sim.hidden.base import HiddenEffect

STEP, SLIDE = math.radians(0.37), 1.3e-3
STEPS = drives.ServoQuantisation(at(2, STEP) + at(3, SLIDE))


def looked(rows: Session, arm: Arm = ARM) -> ExplainedSession:
    """A session explained by gains and steps, with the declared geometry."""
    base = declared_model(arm)
    tried = list_candidates(arm, rows.context(), (JointGain, ServoQuantisation), base.terms)
    return explain_session(base, rows, tried.testable, stepped=tried.stepped, functions=False)


def steps(state: ExplainedSession) -> list[int]:
    """Joints whose steps were found, or offered at last."""
    terms = [*state.chosen_terms, *(c.terms[0] for c in state.candidates if c.scanned)]
    return [t.joint for t in terms if isinstance(t, ServoQuantisation)]


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    kinds = (JointGain, ServoQuantisation)
    rows, held = (session([STEPS], n=n, seed=seed) for n, seed in ((200, 3), (60, 9)))
    return diagnose(ARM, rows, test=held, kinds=kinds)


def test_undeclared_steps_are_named_with_their_size(found: Diagnosis) -> None:
    assert (found.verdict, [f.name for f in found.findings]) == ("named", ["servo_quantisation"])
    terms = {t.joint: t for t in found.findings[0].terms}
    assert set(terms) == {2, 3}
    assert 2 * math.pi / terms[2].steps_per_turn == pytest.approx(STEP, rel=1e-3)
    assert terms[3].step_m == pytest.approx(SLIDE, rel=1e-3)
    assert "0.37° each" in terms[2].reading
    assert terms[3].reading == "steps of 1.3 mm"


def test_the_tip_stands_where_the_found_steps_say(found: Diagnosis, tmp_path: Path) -> None:
    """At poses that no row had: without the steps it is 1.4 mm off."""
    save_model(tmp_path / "model.yaml", store(found.model))
    model = load_model(tmp_path / "model.yaml", ARM)
    q = np.random.default_rng(9).uniform(ARM.lower, ARM.upper, (200, ARM.n))
    true = tip([STEPS], q, np.zeros(len(q)))
    error = np.linalg.norm(model.tip(q) - true, axis=1)
    assert np.median(error) < SIGMA / 2
    before = found.models["calibrated"]
    assert np.median(error) < 0.1 * np.median(np.linalg.norm(before.tip(q) - true, axis=1))


@pytest.mark.parametrize("levels", [0, 30, 4])
def test_nothing_hidden_shows_no_step(levels: int) -> None:
    for seed in range(3):
        state = looked(session(n=150, seed=seed, levels=levels))
        assert steps(state) == []


def test_fine_steps_are_found_with_their_size() -> None:
    """As fine as what people round to: more than 1,000 steps in the range."""
    step = math.radians(0.06)
    state = looked(session([drives.ServoQuantisation(at(1, step))], n=400, seed=3))
    assert (ARM.upper[0] - ARM.lower[0]) / step > 1000
    assert steps(state) == [1]
    assert 2 * math.pi / state.chosen_terms[0].forms["steps_per_turn"] == pytest.approx(
        step, rel=1e-3
    )


def test_on_few_levels_a_step_is_not_looked_for() -> None:
    hidden = drives.ServoQuantisation(at(2, math.radians(0.77)))
    rows = session([hidden], n=200, seed=3, levels=5)
    state = looked(rows)
    assert not any(c.scanned for c in state.candidates)
    assert steps(looked(session([hidden], n=200, seed=3))) == [2]


@pytest.mark.parametrize(
    "hidden",
    [drives.CoggingBump(1, 0.6, 0.1, 0.01), drives.CableDrag(1, (0, 3), 0.01)],
    ids=["bump", "drag"],
)
def test_what_is_no_step_is_not_taken_for_one(hidden: HiddenEffect) -> None:
    state = looked(session([hidden], n=200, seed=3))
    assert steps(state) == []


def test_a_step_that_was_looked_for_pays_for_the_looking() -> None:
    odd = ServoQuantisation.of_step(ARM, 2, STEP)
    listed = ServoQuantisation(2, steps_per_turn=1000)
    declared = ServoQuantisation(2, steps_per_turn=0)
    wide = float(ARM.upper[1] - ARM.lower[1])
    assert odd.price(ARM) == pytest.approx(math.log(4 * wide / STEP))
    assert listed.price(ARM) == declared.price(ARM) == 0.0
    fitted = looked(session(n=60)).fit
    columns = FitColumns(fitted)
    marginal = columns.marginal_without(())
    (found,) = evidence_of_each(fitted, marginal, [Candidate(odd.name, (odd,))])
    shift = fitted.whiten_columns(columns.shift_by([odd])[..., None])[:, 0]
    gain = marginal.project(shift) @ (marginal.y - 0.5 * shift)
    assert found == pytest.approx(gain - odd.price(ARM))


def test_a_joint_that_declares_its_step_is_not_scanned() -> None:
    joints = list(ARM.joints)
    joints[1] = joints[1].model_copy(update={"step_deg": 0.5})
    arm = ARM.model_copy(update={"joints": tuple(joints)})
    rows = session([STEPS], n=120, seed=3)
    assert 2 not in steps(looked(rows, arm))


def test_effects_that_were_not_asked_for_are_not_scanned() -> None:
    rows = session([STEPS], n=120, seed=3)
    assert list_candidates(ARM, rows.context(), (JointGain,)).stepped == ()
    assert list_candidates(ARM, rows.context()).stepped == (ServoQuantisation,)
    assert ServoQuantisation in searched_effects()
