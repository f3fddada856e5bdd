"""Slides without a declared guide: a column that bends, leans with its extension, or rocks."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from column_arm import BENT, COLUMN, EI, arm
from few_effects import names_alone

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraDrift
from longarm_comp.core.effects.catalogue import LIBRARY
from longarm_comp.core.effects.compliances import LinkBending
from longarm_comp.core.effects.drive_errors import GuideCurvature, JointGain
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.plays import SlidePlay, TelescopeClearance
from longarm_comp.core.effects.slow_changes import BaseSettling
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State
from longarm_comp.sim.hidden.base import HiddenEffect, Place
from longarm_comp.sim.rods import Walker


@dataclass(frozen=True)
class Rocking(HiddenEffect):
    """What the slide of row `row` carries rocks by `angle` (rad) to its heavy side."""

    row: int
    angle: float

    def give(self, place: Place, beyond: Walker, state: State) -> np.ndarray | None:
        if place.kind != "frame" or place.row != self.row:
            return None
        across = beyond.moment.copy()
        across[2] = 0.0
        return self.angle * across / np.maximum(np.sqrt(np.sum(across**2, axis=0)), 1e-12)


def poses(n: int) -> np.ndarray:
    declared = arm()
    return np.random.default_rng(3).uniform(declared.lower, declared.upper, (n, declared.n))


def bent(q: np.ndarray) -> np.ndarray:
    """The same column, with its beam declared, as an exact rod."""
    return TrueArm(arm(BENT)).tip(q)


def leaning(q: np.ndarray, about_x: float = 4e-3, about_y: float = -3e-3) -> np.ndarray:
    """Along the arc of constant curvature, in small steps of the guide; then the rigid arm."""
    beyond = Arm.parse(
        COLUMN
        | {
            "joints": [
                {"id": 1, "type": "prismatic", "limits_m": [0.0, 1.2]},
                *COLUMN["joints"][1:],
            ]
        },
        "test",
    )
    out = []
    for one in q:
        steps = 400
        step = one[0] / steps
        turn = np.eye(3)
        at = np.array([0.0, 0.0, 0.4])
        w = np.array([about_x, about_y, 0.0]) * step
        small = np.eye(3) + np.array([[0, 0, w[1]], [0, 0, -w[0]], [-w[1], w[0], 0]])
        for _ in range(steps):
            at = at + turn @ np.array([0.0, 0.0, step])
            turn = turn @ small
        rest = TrueArm(beyond).tip(np.array([0.0, *one[1:]]))
        out.append(at + turn @ rest)
    return np.array(out)


def rocking(q: np.ndarray) -> np.ndarray:
    return TrueArm(arm(), [Rocking(1, 6e-3)]).tip(q)


SLIDES: dict[str, tuple[Any, Effect]] = {
    "link_bending": (bent, LinkBending(row=1, bending=1 / EI)),
    "guide_curvature": (leaning, GuideCurvature(joint=1, about_x=4e-3, about_y=-3e-3)),
    "slide_play": (rocking, SlidePlay(joint=1, tilt=6e-3)),
}


@pytest.mark.parametrize("name", SLIDES)
def test_the_effect_is_what_the_true_column_does(name: str) -> None:
    truth, effect = SLIDES[name]
    q = poses(40)
    straight = TrueArm(arm()).tip(q)
    moved = truth(q) - straight
    assert np.linalg.norm(moved, axis=1).mean() > 1e-3
    said = Model(arm(), (effect,)).tip(q) - Model(arm()).tip(q)
    assert np.abs(said - moved).max() < 0.02 * np.linalg.norm(moved, axis=1).max()


@pytest.mark.parametrize(
    "name", [pytest.param("guide_curvature", marks=pytest.mark.long), "slide_play"]
)
def test_a_diagnosis_names_it_and_its_size(name: str) -> None:
    truth, effect = SLIDES[name]
    q = poses(140)
    seen = truth(q) + np.random.default_rng(4).normal(0.0, 3e-4, (len(q), 3))
    kinds = (LinkBending, GuideCurvature, SlidePlay, JointGain)
    rows = Session.record(q, seen)
    rows, held = rows.take(slice(100)), rows.take(slice(100, 140))
    with names_alone():
        found = diagnose(arm(), rows, test=held, seed=1, kinds=kinds)
    (finding,) = found.findings
    assert finding.name == name
    assert finding.where == (effect.where,)
    (term,) = finding.terms
    for parameter in effect.parameters(arm()):
        true, slack = getattr(effect, parameter.name), 0.2 * parameter.prior
        assert getattr(term, parameter.name) == pytest.approx(true, rel=0.25, abs=slack)


def test_a_declared_guide_has_its_own_effects(demo_arm_path) -> None:
    demo = Arm.load(demo_arm_path)
    for kind in (SlidePlay,):
        assert kind in LIBRARY
        assert kind.rows(arm()) == [1]
        assert kind.rows(demo) == []
    assert TelescopeClearance.rows(arm()) == []
    assert GuideCurvature.rows(demo) == [3, 7]


@pytest.mark.long
def test_sinking_and_a_drift_of_the_camera_are_a_set() -> None:
    rng = np.random.default_rng(4)
    q = poses(160)
    t = np.linspace(0.0, 7200.0, len(q))
    model = Model(arm()).plus(BaseSettling(sink=-3e-3))
    seen = model.measured(q, Context(columns={"t_s": t})) + rng.normal(0.0, 3e-4, (len(q), 3))
    kinds = (CameraDrift, BaseSettling, GuideCurvature)
    found = diagnose(arm(), Session.record(q, seen, columns={"t_s": t}), seed=1, kinds=kinds)
    (finding,) = found.findings
    assert {"camera_drift", "base_settling"} <= set(finding.names)
    assert found.verdict == "set"


@pytest.mark.long
def test_a_drift_is_told_from_a_bent_guide() -> None:
    rng = np.random.default_rng(1)
    q = poses(120)
    t = np.linspace(0.0, 7200.0, len(q))
    drift = np.outer(t / 3600.0, [1.5e-3, -1e-3, 0.0])
    seen = TrueArm(arm()).tip(q) + drift + rng.normal(0.0, 3e-4, (len(q), 3))
    rows = Session.record(q, seen, columns={"t_s": t})
    found = diagnose(arm(), rows, seed=1, kinds=(CameraDrift, GuideCurvature))
    assert [f.names for f in found.findings] == [("camera_drift",)]


def test_any_link_may_bend_and_the_declared_ones_take_their_share(demo_arm_path: Path) -> None:
    demo = Arm.load(demo_arm_path)
    (bracket,) = LinkBending.for_arm(demo)
    assert bracket.price(demo) == pytest.approx(math.log(6.0))
    assert LinkBending(1).price(arm()) == 0.0


def test_links_that_bend_and_are_not_declared_are_named() -> None:
    """Where the truth has a column and two links as exact rods, the declared arm is rigid."""
    beams = [
        {"name": f"link {k}", "row": k, "role": "a", "length_m": long, "EI_nm2": ei, "GJ_nm2": 2500}
        for k, long, ei in ((3, 0.8, 3000.0), (4, 0.6, 2000.0))
    ]  # fmt: skip
    truth = TrueArm(arm(BENT, *beams))
    q = poses(160)
    rows = Session.record(q, truth.tip(q) + np.random.default_rng(4).normal(0, 3e-4, (len(q), 3)))
    new = np.random.default_rng(8).uniform(arm().lower, arm().upper, (200, 4))
    held = Session.record(new[:60], truth.tip(new[:60]))
    kinds = (LinkBending, GuideCurvature, SlidePlay)
    with names_alone():
        found = diagnose(arm(), rows, test=held, seed=1, kinds=kinds)
    assert [(f.names, f.where) for f in found.findings] == [
        (("link_bending",), ("row 1", "row 3", "row 4"))
    ]
    bending = {t.row: t.bending for t in found.model.effects if isinstance(t, LinkBending)}
    assert bending == pytest.approx({1: 1 / EI, 3: 1 / 3000.0, 4: 1 / 2000.0}, rel=0.2)
    assert np.linalg.norm(found.model.tip(new) - truth.tip(new), axis=1).mean() < 2e-4
