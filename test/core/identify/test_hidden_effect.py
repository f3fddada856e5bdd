"""Tests that catch a fake diagnosis: truth from the independent simulator, small and seeded."""

import ast
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from few_effects import FEW
from hidden_arm import SIGMA, Draw, at, session, tip, white
from small_arm import ARM

import longarm_comp.sim
from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import LIBRARY
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain, ServoQuantisation
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis
from longarm_comp.core.identify.candidate_states import find_smallest_sizes
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.model.model import Model
from longarm_comp.sim.hidden import drives, geometry
from longarm_comp.sim.hidden.base import HiddenEffect
from studies.many import compensate_arrays

GAIN = (drives.JointGain(at(2, 0.02)),)
LAG = (drives.FrictionHysteresis(at(2, 0.006)),)


def diagnosed(
    rows: Session,
    hidden: Sequence[HiddenEffect] = (),
    kinds: Sequence[type[Effect]] = FEW,
    noise: Draw = white,
) -> Diagnosis:
    """The proof is by rows of its own: five fits less than by folds."""
    return diagnose(ARM, rows, test=session(hidden, n=40, seed=9, noise=noise), kinds=kinds)


@pytest.fixture(scope="module")
def gain() -> Diagnosis:
    return diagnosed(session(GAIN), GAIN)


def names(found: Diagnosis) -> set[str]:
    return {name for f in found.findings for name in f.names}


def value(found: Diagnosis, parameter: str, where: str) -> float:
    return next(
        float(v)
        for slot, v in zip(found.fit.slots, found.fit.model.values, strict=True)
        if slot.parameter.name == parameter and slot.owner.where == where
    )


# 1
def test_shuffled_residuals_are_noise(gain: Diagnosis, rng: np.random.Generator) -> None:
    whole = session(GAIN)
    left = fit_model(gain.models["calibrated"], whole).residual
    order = rng.permutation(len(whole))
    mixed = dataclasses.replace(whole, xyz=Model(ARM).tip(whole.q) + left[order])
    found = diagnosed(mixed)
    assert (found.verdict, found.findings) == ("noise", ())


@pytest.fixture(scope="module")
def nothing() -> Diagnosis:
    return diagnosed(session())


# 2
@dataclasses.dataclass(frozen=True)
class Renamed(JointGain):
    name: ClassVar[str] = "zebra"


def test_names_and_order_do_not_matter(gain: Diagnosis, rng: np.random.Generator) -> None:
    whole = session(GAIN)
    mixed = whole.take(rng.permutation(len(whole)))
    kinds = tuple(Renamed if kind is JointGain else kind for kind in reversed(FEW))
    again = diagnosed(mixed, GAIN, kinds)
    renamed = {"zebra" if name == "joint_gain" else name for name in names(gain)}
    assert names(again) == renamed
    assert [f.where for f in again.findings] == [("joint 2",)]
    here, there = (value(d, "gain", "joint 2") for d in (gain, again))
    assert here == pytest.approx(there, abs=1e-4)


@pytest.mark.long
# 3
def test_place_sign_and_value_follow_the_truth() -> None:
    joint, size = 1, -0.02
    found = diagnose(ARM, session([drives.JointGain(at(joint, size))]))
    assert "joint_gain" in names(found)
    assert [f.where for f in found.findings] == [(f"joint {joint}",)]
    k = next(k for k, s in enumerate(found.fit.slots) if s.parameter.name == "gain")
    interval = found.intervals[k]
    half = (interval.high - interval.low) / 2
    assert abs(interval.value - size) < 1.7 * half  # 99.9 %: sound for a fixed seed
    assert half < abs(size) / 2


# 4
def test_geometry_errors_alone_are_no_effect() -> None:
    rng = np.random.default_rng(0)
    errors = [
        geometry.JointZero(4e-3 * rng.standard_normal(4)),
        geometry.DhError(1e-3 * rng.standard_normal((4, 4))),
        geometry.BasePose(2e-3 * rng.standard_normal(6)),
    ]
    found = diagnose(ARM, session(errors, seed=0))
    assert (found.verdict, found.findings) == ("noise", ())
    assert found.proof.rows["calibrated"].mean < 0.5 * found.proof.rows["nominal"].mean


# 5
OTHERS = (JointCompliance, Backlash, ServoQuantisation)


@pytest.mark.parametrize("library", [OTHERS, pytest.param(LIBRARY, marks=pytest.mark.long)])
def test_without_the_true_family_no_wrong_name_is_sure(library: Sequence[type[Effect]]) -> None:
    kinds = tuple(k for k in library if k not in (JointGain, GearEccentricity))
    far = [drives.JointGain(at(1, 0.05))]
    found = diagnosed(session(far), far, kinds)
    assert found.verdict != "named"
    assert found.verdict != "noise"


# 6
def test_aliases_on_three_levels_stay_a_set() -> None:
    found = diagnosed(session(GAIN, n=90, levels=3), GAIN)
    assert found.verdict == "set"
    assert names(found) >= {"joint_gain", "gear_eccentricity"}


# 7
@pytest.mark.parametrize(
    "kinds",
    [(JointGain, GearEccentricity), pytest.param(LIBRARY, marks=pytest.mark.long)],
)
def test_dose_decides_between_invisible_set_and_named(
    nothing: Diagnosis, kinds: Sequence[type[Effect]]
) -> None:
    found = {0.0: nothing} | {
        dose: diagnosed(session(far, n=150), far, kinds)
        for dose, far in ((d, [drives.JointGain(at(1, d))]) for d in (0.006, 0.1))
    }
    assert {dose: d.verdict for dose, d in found.items()} == {
        0.0: "noise",
        0.006: "set",
        0.1: "named",
    }
    assert names(found[0.1]) == {"joint_gain"}


def test_the_smallest_visible_size_is_between_unseen_and_found(nothing: Diagnosis) -> None:
    options = [c for c in nothing.explained.candidates if c.name == "joint_gain"]
    smallest = next(
        d
        for d in find_smallest_sizes(
            nothing.explained.fit, options, nothing.explained.needed_evidence
        )
        if d.candidate.where == ("joint 2",)
    )
    prior = smallest.candidate.slots(ARM)[0].parameter.prior
    for factor, seen in ((0.4, False), (2.0, True)):
        size = factor * smallest.size * prior
        far = [drives.JointGain(at(2, size))]
        found = diagnosed(session(far), far, (JointGain,))
        assert bool(found.explained.chosen_terms) == seen


# 9
def test_the_truth_shares_no_physics_with_what_judges_it() -> None:
    """The simulated arm and its hidden effects import declarations only."""
    folder = Path(longarm_comp.sim.__file__).parent
    files = [folder / f for f in ("arm_truth.py", "rods.py", "ringing.py")]
    for path in [*files, *(folder / "hidden").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("longarm_comp."):
                allowed = ("sim", "core.arm", "core.errors", "core.files")
                assert str(node.module).removeprefix("longarm_comp.").startswith(allowed), path


# 10
def test_a_commanded_arm_lands_closer_and_leaves_nothing_to_find(gain: Diagnosis) -> None:
    rng = np.random.default_rng(4)
    n = 120
    share = 0.1 + 0.8 * rng.random((n, ARM.n))
    q = ARM.lower + share * (ARM.upper - ARM.lower)
    targets, side = Model(ARM).tip(q), rng.choice([-1.0, 1.0], n)
    context = Context(tuple(side for _ in range(ARM.n)))
    options = {"seed": q, "context": context, "position_only": True}
    missed = {}
    for name in ("nominal", "calibrated", "with_effects"):
        command = compensate_arrays(gain.models[name], None, targets, **options).command
        reached = tip(GAIN, command, side)
        missed[name] = float(np.linalg.norm(reached - targets, axis=1).mean())
    assert missed["with_effects"] < 0.5 * missed["calibrated"] < 0.5 * missed["nominal"]
    assert missed["with_effects"] < SIGMA
    again = Session.record(command, reached + white(rng, n), approach=side)
    found = diagnose(ARM, again, model=gain.model, kinds=FEW)
    assert (found.verdict, found.findings) == ("noise", ())


# 11
def correlated(rng: np.random.Generator, n: int) -> np.ndarray:
    made = rng.standard_normal((n, 3))
    for k in range(1, n):
        made[k] = 0.9 * made[k - 1] + np.sqrt(1 - 0.81) * made[k]
    return SIGMA * made


def tailed(rng: np.random.Generator, n: int) -> np.ndarray:
    return SIGMA * rng.standard_t(3, (n, 3)) / np.sqrt(3)


def outlying(rng: np.random.Generator, n: int) -> np.ndarray:
    return white(rng, n) * np.where(rng.random(n) < 0.12, 50.0, 1.0)[:, None]


@pytest.mark.parametrize(
    "noise", [correlated, pytest.param(tailed, marks=pytest.mark.long), outlying]
)
def test_ugly_noise_is_no_effect(noise: Draw) -> None:
    found = diagnosed(session(noise=noise), noise=noise)
    assert (found.verdict, found.findings) == ("noise", ())


@pytest.mark.long
def test_an_effect_is_found_among_outliers() -> None:
    found = diagnose(ARM, session(GAIN, noise=outlying))
    assert "joint_gain" in names(found)
    assert value(found, "gain", "joint 2") == pytest.approx(0.02, abs=3e-3)


def test_without_a_direction_nothing_directional_is_tested() -> None:
    rows = dataclasses.replace(session(), approach=np.zeros((120, ARM.n), np.int8))
    tried = list_candidates(ARM, rows.context())
    directional = {Backlash.name, FrictionHysteresis.name}
    assert directional <= {name for name, _ in tried.not_testable}
    assert directional.isdisjoint(c.name for c in tried.testable)
