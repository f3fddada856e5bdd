"""The decision on a hold-out: few poses by their odds, many by more than chance, outliers not."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hidden_arm import at, session
from small_arm import ARM

from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.identify.calibrate import geometry
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.discover.hold_out import together
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.proof import (
    AGAINST,
    DECIDES,
    NETWORK,
    Proof,
    _better,
    _log_odds,
    _Unseen,
    off_levels,
    prove,
)
from longarm_comp.core.model.model import Model
from longarm_comp.sim.hidden import drives
from longarm_comp.sim.hidden.geometry import JointZero

SPREAD = 1e-4


def errors(rng: np.random.Generator, rows: int, size: float) -> np.ndarray:
    return SPREAD * rng.standard_normal((rows, 3)) + size


def better(before: np.ndarray, after: np.ndarray, rng: np.random.Generator) -> bool:
    held, spread = np.ones(before.shape, bool), np.full(before.shape, SPREAD)
    old, new = (_Unseen(error, spread, held, np.ones(3)) for error in (before, after))
    return _better(old, new, rng)


@pytest.mark.parametrize(("worse", "verdict"), [(1.3, False), (1.05, True), (0.95, True)])
def test_a_small_hold_out_withdraws_an_effect_only_beyond_odds_of_twenty(
    worse: float, verdict: bool, rng: np.random.Generator
) -> None:
    before = errors(rng, 6, 0.0)
    after = worse * before
    assert (((before - after) / SPREAD) ** 2).sum() < DECIDES
    assert better(before, after, rng) is verdict


def test_a_large_hold_out_must_have_improved_beyond_chance(rng: np.random.Generator) -> None:
    before = errors(rng, 60, 3 * SPREAD)
    assert better(before, before - 3 * SPREAD, rng)
    assert not better(before - 3 * SPREAD, before, rng)
    shuffled = before[rng.permutation(60)]
    assert (((before - shuffled) / SPREAD) ** 2).sum() > DECIDES
    assert not better(before, shuffled + 1e-12, rng)


@pytest.mark.parametrize(("sigmas", "odds"), [(2.0, 2.0), (20.0, AGAINST), (-20.0, -200.0)])
def test_no_single_row_makes_odds_for_an_effect(sigmas: float, odds: float) -> None:
    held, spread = np.ones((5, 3), bool), np.full((5, 3), SPREAD)
    none, one = np.zeros((5, 3)), np.zeros((5, 3))
    one[2, 0] = sigmas * SPREAD
    before, after = (one, none) if sigmas > 0 else (none, one)
    pair = (_Unseen(error, spread, held, np.ones(3)) for error in (before, after))
    assert _log_odds(*pair) == pytest.approx(odds)


def test_few_rows_leave_the_fit_uncertain_and_unseen_rows_know_it() -> None:
    """Residuals of poses far from those few are as large as noise and uncertainty say."""
    hidden = (JointZero(np.array([0.012, -0.01, 0.001, 0.008])),)

    def white(rng: np.random.Generator, n: int) -> np.ndarray:
        return SPREAD * rng.standard_normal((n, 3))

    rows, far = (session(hidden, n=n, seed=n, noise=white) for n in (120, 300))
    near = rows.take(np.argsort(np.abs(rows.q - ARM.mid).sum(axis=1))[:10])
    model = Model(ARM).plus(*geometry(ARM, near))
    unseen = _Unseen.of(fit(model, near, sigma=np.full(3, SPREAD)), far)
    assert np.sqrt(np.mean((unseen.residual / SPREAD) ** 2)) > 2
    assert 0.3 < np.sqrt(np.mean((unseen.residual / unseen.spread) ** 2)) < 1.5


def missed(error: np.ndarray) -> np.ndarray:
    held, spread = np.ones(error.shape, bool), np.full(error.shape, SPREAD)
    return _Unseen(error, spread, held, np.ones(3)).missed


def test_a_row_that_is_far_off_is_an_outlier_beside_the_other_rows(
    rng: np.random.Generator,
) -> None:
    error = errors(rng, 60, 0.0)
    error[7, 1] += 8 * SPREAD
    np.testing.assert_array_equal(np.flatnonzero(missed(error)), [7])
    assert not missed(20 * np.delete(error, 7, axis=0)).any()  # it errs everywhere alike


def test_outliers_of_the_hold_out_withdraw_no_true_effect() -> None:
    """Both models miss two rows by 2 cm, the true one by a little more."""
    gain = (drives.JointGain(at(2, 0.02)),)
    whole, held = session(gain), session(gain, n=60, seed=9)
    sound = diagnose(ARM, whole, test=held, kinds=(JointGain,))
    assert sound.proof.set_aside == 0
    new, old = (sound.models[name].tip(held.q) for name in ("with_effects", "calibrated"))
    length = np.linalg.norm(new - old, axis=1)
    worst = length.argsort()[-2:]
    xyz = held.xyz.copy()
    xyz[worst] -= 20e-3 * ((new - old) / length[:, None])[worst]
    spoilt = diagnose(ARM, whole, test=dataclasses.replace(held, xyz=xyz), kinds=(JointGain,))
    assert not spoilt.rolled_back
    assert [f.name for f in spoilt.findings] == ["joint_gain"]
    assert spoilt.proof.set_aside == 2
    assert "2 of 60 rows set aside" in spoilt.summary


@pytest.mark.parametrize(
    ("log_odds", "kept"), [(2.0, True), (-0.9 * AGAINST, True), (-1.1 * AGAINST, False)]
)
def test_strong_evidence_needs_a_hold_out_that_agrees(
    log_odds: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bootstrap of the held-out poses touches 0."""

    def undecided(*args: Any) -> Proof:
        return dataclasses.replace(prove(*args), better=False, log_odds=log_odds)

    monkeypatch.setattr("longarm_comp.core.identify.diagnose.prove", undecided)
    gain = (drives.JointGain(at(2, 0.02)),)
    found = diagnose(ARM, session(gain), test=session(gain, n=60, seed=9), kinds=(JointGain,))
    assert found.search.chosen
    assert found.rolled_back is not kept


def test_effects_of_a_size_that_no_arm_has_are_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """They stand in for something else; the report says which, and that it is not known."""
    rows, held_out = (session((drives.JointGain(at(2, 0.1)),), seed=s) for s in (1, 9))
    monkeypatch.setattr("longarm_comp.core.identify.plausible.INCREDIBLE", 1.8)
    no_function = "longarm_comp.core.identify.diagnose.look_further"
    monkeypatch.setattr(no_function, lambda *_: None)
    found = diagnose(ARM, rows, test=held_out, kinds=(JointGain,))
    assert found.search.chosen
    assert found.rolled_back
    assert (found.findings, found.verdict) == ((), "unknown")
    assert "joint_gain at joint 2: gain 0." in found.summary
    assert "is not credible (typical 0.05)" in found.summary


@pytest.mark.parametrize(
    ("evidence", "log_odds", "after", "borne"),
    [
        (30.0, 4.5, 0.9, True),
        (30.0, 3.5, 0.9, False),
        (300.0, -2.0, 0.9, True),
        (300.0, -3.2, 0.9, False),
        (300.0, 9.0, 1.1, False),
    ],
)
def test_both_kinds_of_poses_together(
    evidence: float, log_odds: float, after: float, borne: bool
) -> None:
    before = np.full((40, 3), 1e-3)
    left = {"calibrated": before, "with_effects": after * before}
    proof = Proof(left, {}, {}, False, 1.0, 0.0, 1.0, log_odds=log_odds)
    assert together(proof, evidence) is borne
    assert not together(proof, evidence, rho=0.95)


# ------------------------------------------------------------------ a network off the grid's levels


def helps(on: float, between: float, off: np.ndarray) -> bool:
    """Of a network that leaves a share of the error on the levels, and one between them."""
    before = np.full((len(off), 3), 1e-3)
    left = {"with_effects": before, NETWORK: before * np.where(off, between, on)[:, None]}
    proof = Proof(left, {}, {}, True, 1.0, 0.0, 1.0, off_levels=off)
    return proof.network_helps("with_effects")


def test_a_network_is_kept_only_where_it_helps_between_the_levels() -> None:
    off = np.arange(60) % 3 == 0
    assert helps(0.3, 0.3, off)
    assert not helps(0.1, 1.2, off)
    assert not helps(1.5, 0.9, off)
    assert not helps(0.3, 0.3, np.zeros(60, bool))


def test_rows_between_the_levels_of_a_grid(rng: np.random.Generator) -> None:
    grid = rng.integers(5, size=(200, 3)) / 4.0 * [1.0, 0.5, 2.0]
    grid[:, 1] = rng.uniform(0.0, 0.5, 200)
    on = np.array([[0.25, 0.1234, 1.5], [0.26, 0.4, 1.98]])
    between = np.array([[0.375, 0.1, 1.5], [0.5, 0.1, 1.2]])
    np.testing.assert_array_equal(off_levels(grid, np.concatenate([on, between])), [0, 0, 1, 1])
    assert off_levels(rng.random((200, 3)), on).all()
