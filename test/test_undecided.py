"""A name is withdrawn where only rows speak for it in which a switch is undecided."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from demo_rows import session_of

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.backlash import Backlash
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.gravity_direction import GravityDirection
from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.effects.joint_term import typical_loads
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.identify.calibrate import geometry
from longarm_comp.core.identify.candidates import Candidate
from longarm_comp.core.identify.evidence import columns_at
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.noise import NoiseEstimate
from longarm_comp.core.identify.search import SearchResult
from longarm_comp.core.identify.search_state import SearchState
from longarm_comp.core.identify.thresholds import undecided
from longarm_comp.core.identify.undecided import without_undecided
from longarm_comp.core.model.model import Model

PLAY = Backlash(6, gate=0.1, blend=0.05, width=0.03)


@pytest.fixture(scope="module")
def arm(demo_arm_path: Path) -> Arm:
    return Arm.load(demo_arm_path)


def result_of(arm: Arm, seed: int, hidden: tuple[Effect, ...], *found: Effect) -> SearchResult:
    """A search that ended with some effects, all rows believed."""
    rows = session_of(arm, seed, *hidden)
    model = Model(arm, (LinkDeflection(), *geometry(arm, rows), *found))
    sigma = np.full(3, 4e-4)
    fitted = fit(model, rows, sigma=sigma, weights=np.ones(len(rows)))
    noise = NoiseEstimate(sigma, "repeats", 0.0, 100.0)
    return SearchResult(fitted, found, noise, (), (), threshold=8.0)


def test_a_name_of_undecided_rows_alone_goes_with_them(arm: Arm) -> None:
    """The threshold is a little off: gravity is turned by 1.8 deg to put a few rows right."""
    off = dataclasses.replace(PLAY, gate=1.05 * PLAY.gate)
    before = result_of(arm, 10, (PLAY,), off, GravityDirection())
    play, turned = (
        t for t in before.fit.model.terms if t.name in ("backlash", "gravity_direction")
    )
    assert isinstance(play, Backlash) and isinstance(turned, GravityDirection)
    assert abs(turned.about_x) > np.radians(1.5)
    rows = undecided(before.fit, columns_at(before.fit), [play])
    after, gone = without_undecided(before, lambda said: None)
    assert [m.name for m in gone] == ["gravity_direction"]
    assert f"rests on {rows.sum()} rows" in gone[0].why
    assert np.array_equal(np.flatnonzero(rows), after.fit.outliers)
    assert [t.name for t in after.chosen] == ["backlash"]
    # they are the rows whose load is within a tenth of the threshold
    loads = np.abs(play.load(before.fit.posture)) / (off.gate * typical_loads(arm)[1])
    assert 0 < rows.sum() < 10
    assert np.abs(loads[rows] - 1.0).max() < 0.15


def test_a_name_that_all_rows_speak_for_stays(arm: Arm) -> None:
    off = dataclasses.replace(PLAY, gate=1.05 * PLAY.gate)
    before = result_of(arm, 1, (PLAY, JointGain(2, gain=1e-2)), off, JointGain(2))
    after, gone = without_undecided(before, lambda said: None)
    assert after is before
    assert gone == ()


def test_what_undecided_rows_alone_speak_for_is_not_added(arm: Arm) -> None:
    off = dataclasses.replace(PLAY, gate=1.05 * PLAY.gate)
    found = result_of(arm, 2, (PLAY,), off)
    base = Model(arm, (LinkDeflection(), *geometry(arm, found.fit.session)))
    turned = Candidate("gravity_direction", (GravityDirection(),))
    state = SearchState(base, found.fit.session, [turned], None)
    state.chosen, state.fit = {off.key: off}, found.fit
    state._look()
    (best,) = state.scores()
    assert best.log_bayes_factor > 50.0 > state.threshold
    assert state.best() is None
    state._sure = None
    assert state.best() is not None
