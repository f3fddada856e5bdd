"""A weak name is withdrawn where the stronger effect's own form may be what is not right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
from demo_rows import session_of

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Twist
from longarm_comp.core.effects.bearing_tilt import BearingTilt
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.gear_eccentricity import GearEccentricity
from longarm_comp.core.effects.joint_compliance import JointCompliance
from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.identify.calibrate import geometry
from longarm_comp.core.identify.candidates import library
from longarm_comp.core.identify.minor import Minor
from longarm_comp.core.identify.remainder import without_remainders
from longarm_comp.core.identify.search import search
from longarm_comp.core.model.model import Model

KINDS = (JointCompliance, JointGain, GearEccentricity, BearingTilt)


@dataclass(frozen=True)
class Uneven(JointCompliance):
    """A gear that is up to 60 % softer at the ends of its way than in the middle."""

    name: ClassVar[str] = "uneven_compliance"

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        j = posture.arm.commanded.index(self.joint)
        low, high = posture.arm.lower[j], posture.arm.upper[j]
        x = (2.0 * posture.q[j] - low - high) / (high - low)
        even = self.compliance * self.load(posture)
        return self.motion(posture, even * (1.0 + 0.35 * (1.5 * x * x - 0.5 + 0.5 * x)))


@pytest.fixture(scope="module")
def arm(demo_arm_path: Path) -> Arm:
    return Arm.load(demo_arm_path)


def found(arm: Arm, seed: int, *hidden: Effect) -> tuple[set[str], set[str], tuple[Minor, ...]]:
    """Names before and after, and what was withdrawn."""
    rows = session_of(arm, seed, *hidden)
    base = Model(arm, (LinkDeflection(), *geometry(arm, rows)))
    before = search(base, rows, library(arm, rows.context(), KINDS, base.terms).testable)
    after, gone = without_remainders(before, lambda said: None)
    return {t.name for t in before.chosen}, {t.name for t in after.chosen}, gone


def test_the_misfit_of_a_form_gets_no_name(arm: Arm) -> None:
    before, after, gone = found(arm, 1, Uneven(2, compliance=2e-2))
    assert before == {"joint_compliance", "joint_gain"}
    assert after == {"joint_compliance"}
    assert [m.name for m in gone] == ["joint_gain"]
    assert "joint_compliance may differ from its form" in gone[0].why


def test_a_name_that_takes_much_of_the_residual_stays(arm: Arm) -> None:
    """Commands are better with it, whatever it stands for."""
    before, after, gone = found(arm, 3, Uneven(2, compliance=2e-2))
    assert before == after == {"joint_compliance", "joint_gain"}
    assert gone == ()


def test_a_weak_effect_beside_a_strong_one_keeps_its_name(arm: Arm) -> None:
    hidden = JointCompliance(2, compliance=2e-2), JointGain(2, gain=1e-2)
    before, after, gone = found(arm, 1, *hidden)
    assert before == after == {"joint_compliance", "joint_gain"}
    assert gone == ()
