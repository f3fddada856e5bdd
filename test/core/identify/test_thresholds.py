"""Thresholds by all rows: those on the wrong side are no outliers."""

import dataclasses

import numpy as np
import pytest
from rows_with_play import session_of

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.candidates import Candidate, list_candidates
from longarm_comp.core.calibration.fit import fit_model, linearise_model
from longarm_comp.core.calibration.linear import OUTLIER
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.identify.posterior.forms import _search_scales, refine_form
from longarm_comp.core.model.model import Model

PLAY = Backlash(6, gate=0.1, blend=0.01, width=0.03)
SIGMA = np.full(3, 4e-4)


@pytest.fixture(scope="module")
def rows(arm: Arm) -> Session:
    return session_of(arm, 1, PLAY)


def fitted(arm: Arm, rows: Session, start: Backlash, *others: JointCompliance) -> ModelFit:
    """A fit to the rows that a threshold does not contradict, taken for granted."""
    model = Model(arm, (LinkDeflection(), *geometry_terms(arm, rows), start, *others))
    off = np.abs(linearise_model(model, rows).residual) / (OUTLIER * SIGMA)
    return fit_model(model, rows, sigma=SIGMA, weights=(off.max(axis=1) <= 1.0).astype(float))


def tried(arm: Arm, rows: Session) -> tuple[Candidate, ...]:
    return list_candidates(arm, rows.context(), (Backlash,)).testable


def play_of(found: ModelFit) -> Backlash:
    term = next(t for t in found.model.terms if t.name == "backlash")
    assert isinstance(term, Backlash)
    return term


@pytest.mark.parametrize(("gate", "blend"), [(0.14, 0.01), (0.07, 0.1)])
def test_rows_set_aside_on_the_wrong_side_move_the_threshold(
    arm: Arm, rows: Session, gate: float, blend: float
) -> None:
    found = fitted(arm, rows, dataclasses.replace(PLAY, gate=gate, blend=blend))
    assert len(found.outliers) > 1
    moved = refine_form(found, play_of(found), tried(arm, rows))
    assert isinstance(moved, Backlash)
    assert moved.gate == pytest.approx(0.1, abs=0.01)
    assert moved.blend < 0.03


def test_a_threshold_that_rows_agree_on_stays(arm: Arm, rows: Session) -> None:
    """Also beside outliers that no threshold explains, and without any."""
    xyz = rows.xyz.copy()
    xyz[[3, 40, 71]] += 0.02
    for session in (rows, dataclasses.replace(rows, xyz=xyz)):
        found = fitted(arm, session, PLAY, JointCompliance(2))
        moved = refine_form(found, play_of(found), tried(arm, rows))
        assert moved.gate == pytest.approx(0.1, abs=0.01)  # type: ignore[union-attr]
    assert (np.abs(found.residual[[3, 40, 71]]) > OUTLIER * SIGMA).any(axis=1).all()


@pytest.mark.parametrize("seed", [1, pytest.param(4, marks=pytest.mark.long)])
def test_the_search_ends_at_a_threshold_between_two_that_are_tried(arm: Arm, seed: int) -> None:
    """By the believed rows alone it ended at 0.75, with six and ten flipped rows set aside."""
    rows = session_of(arm, seed, dataclasses.replace(PLAY, gate=0.2))
    base = Model(arm, (LinkDeflection(), *geometry_terms(arm, rows)))
    found = explain_session(
        base, rows, list_candidates(arm, rows.context(), (Backlash,), base.terms).testable
    )
    assert play_of(found.fit).gate == pytest.approx(0.2, abs=0.005)
    assert len(found.fit.outliers) <= 1


def test_a_form_at_the_end_of_its_scale_stays_on_it() -> None:
    """A mean of ends was the end and a rounding more: a file that could not be read again."""
    term = Backlash(joint=1, gate=0.1, blend=0.1)
    scales = term.scales()
    grid = np.array([[high for _, high in scales.values()]] * 7)
    for seed in range(20):
        draw = np.random.default_rng(seed)
        found = _search_scales(term, grid, lambda terms, d=draw: 9.0 * d.random(len(terms)))
        assert all(low <= getattr(found, f) <= high for f, (low, high) in scales.items())


def test_rounding_of_a_mean_hides_no_half_of_the_search() -> None:
    """A mean of equal values was a rounding beside them, and then one side was not searched."""
    term = Backlash(joint=1, gate=0.9, blend=0.1)
    blends = np.linspace(0.02, 0.08, 7)  # without influence
    for start in np.random.default_rng(0).uniform(0.1, 0.5, 40):
        gates = start + 0.05 * np.arange(5)
        grid = np.array([[gate, blend] for gate in gates for blend in blends])
        for best in (gates[2] - 0.015, gates[2] + 0.015):
            found = _search_scales(
                term,
                grid,
                lambda terms, b=best: np.array([-1e6 * (t.gate - b) ** 2 for t in terms]),
            )
            assert isinstance(found, Backlash)
            assert found.gate == pytest.approx(best, abs=0.003)
