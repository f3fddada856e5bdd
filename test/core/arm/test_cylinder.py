"""A hydraulic boom: a cylinder turns joint 2 through two pins."""

from dataclasses import dataclass

import numpy as np
import pytest
from cylinder_boom import ANGLE, FAR, NEAR, boom
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import CylinderPins, DhError
from longarm_comp.core.effects.plays import Backlash, CylinderPlay
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.solver import solve_many
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State, TrueContext
from longarm_comp.sim.hidden.base import HiddenEffect

DRAWN = (NEAR, FAR, np.radians(ANGLE))


@dataclass(frozen=True)
class TruePins(HiddenEffect):
    """A joint's cylinder has the length that the drawing asks for, between pins elsewhere.

    The triangle is solved exactly for the angle.

    Attributes:
        joint: index in q.
        drawn: near, far (m) and angle at q = 0 (rad), as declared; the angle grows with q.
        true: near, far (m), and what the sensor's zero adds to the length (m).
    """

    joint: int
    drawn: tuple[float, float, float]
    true: tuple[float, float, float]

    def joints(self, q: np.ndarray, state: State) -> np.ndarray:
        near, far, zero = self.drawn
        length = np.hypot(near - far * np.cos(zero + q[:, self.joint]),
                          far * np.sin(zero + q[:, self.joint]))  # fmt: skip
        a, b, more = self.true
        turned = q.copy()
        turned[:, self.joint] = np.arccos((a**2 + b**2 - (length + more) ** 2) / (2 * a * b)) - zero
        return turned


@dataclass(frozen=True)
class TruePlay(TruePins):
    """Worn pins: the cylinder is half the play shorter or longer, as the approach left it."""

    play: float = 0.0

    def joints(self, q: np.ndarray, state: State) -> np.ndarray:
        came = np.broadcast_to(state.approach, q.shape)[:, self.joint]
        made = q.copy()
        for side in (-1.0, 1.0):
            a, b, more = self.true
            short = TruePins(self.joint, self.drawn, (a, b, more - side * self.play / 2))
            rows = came == side
            made[rows] = short.joints(q, state)[rows]
        return made


@pytest.mark.parametrize("grows", [1, -1])
def test_the_lever_is_the_slope_of_the_length(grows: int) -> None:
    cylinder = boom(angle_deg=90.0, grows=grows).joints[1].cylinder
    assert cylinder is not None
    q = np.linspace(0.2, 1.2, 9)
    slope = (cylinder.length(q + 1e-6) - cylinder.length(q - 1e-6)) / 2e-6
    np.testing.assert_allclose(cylinder.lever(q), slope, rtol=1e-7)
    pins = FAR * np.exp(1j * (np.pi / 2 + grows * q)) - NEAR
    np.testing.assert_allclose(cylinder.length(q), np.abs(pins), rtol=1e-12)


def test_a_cylinder_cannot_pass_the_line_of_its_pins() -> None:
    with pytest.raises(InputError, match=r"joints.1.cylinder.angle_deg: '130.0 to 190.0'"):
        boom(angle_deg=120.0)
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    data["joints"][2]["cylinder"] = {"near_m": NEAR, "far_m": FAR, "angle_deg": ANGLE}
    with pytest.raises(InputError, match=r"joints.2.cylinder.*revolute"):
        Arm.parse(data, "boom.yaml")


def poses(arm: Arm, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random joints, and the side that all of them arrive from."""
    rng = np.random.default_rng(seed)
    return rng.uniform(arm.lower, arm.upper, (n, arm.n)), rng.choice([-1.0, 1.0], n)


@pytest.mark.parametrize("moved", [(1e-3, 0, 0), (0, 1e-3, 0), (0, 0, 1e-3)])
def test_truth_and_model_agree_on_moved_pins(moved: tuple[float, float, float]) -> None:
    arm = boom()
    q, _ = poses(arm, 40, 4)
    near, far, length = moved
    truth = TrueArm(arm, [TruePins(1, DRAWN, (NEAR + near, FAR + far, length))]).tip(q)
    tip = Model(arm).plus(CylinderPins(joint=2, near=near, far=far, length=length)).tip(q)
    effect = np.linalg.norm(truth - Model(arm).tip(q), axis=1)
    assert np.linalg.norm(tip - truth, axis=1).max() < 0.03 * effect.max()
    assert effect.max() > 1e-3


def test_truth_and_model_agree_on_play() -> None:
    arm = boom()
    q, side = poses(arm, 40, 4)
    sides = np.repeat(side[:, None], arm.n, axis=1)
    hidden = TruePlay(1, DRAWN, (NEAR, FAR, 0.0), play=2e-3)
    truth = TrueArm(arm, [hidden]).tip(q, TrueContext(approach=sides))
    model = Model(arm).plus(CylinderPlay(joint=2, width=2e-3))
    tip = model.tip(q, Context(approach=tuple(sides.T)))
    effect = np.linalg.norm(truth - Model(arm).tip(q), axis=1)
    assert np.linalg.norm(tip - truth, axis=1).max() < 0.03 * effect.max()
    assert effect.max() > 1e-3


@pytest.mark.parametrize(
    "term", [CylinderPins(joint=2, near=1e-3, far=-2e-3, length=1e-3),
             CylinderPlay(joint=2, gate=0.1, width=2e-3)]
)  # fmt: skip
def test_the_inverse_kinematics_reach_through_it(term: Effect) -> None:
    arm = boom()
    q, side = poses(arm, 10, 5)
    context = Context(approach=tuple(np.repeat(side[:, None], arm.n, axis=1).T))
    model = Model(arm).plus(term)
    aim = model.tip(q, context)
    found = solve_many(model, aim, seed=q, context=context)
    np.testing.assert_allclose(model.tip(found.q, context), aim, atol=1e-8)


def test_calibration_takes_pins_that_no_other_geometry_can() -> None:
    """At poses left out it errs by less than half of what it does without the cylinder."""
    arm, left = boom(), []
    hidden = TruePins(1, DRAWN, (NEAR + 4e-3, FAR - 6e-3, 3e-3))
    (q, _), (fresh, _) = poses(arm, 60, 6), poses(arm, 100, 7)
    truth = TrueArm(arm, [hidden])
    noise = 2e-5 * np.random.default_rng(8).standard_normal((len(q), 3))
    for declared in (arm, ARM):
        rows = Session.record(q, truth.tip(q) + noise)
        model = fit_model(Model(declared).plus(*geometry_terms(declared, rows)), rows).model
        apart = model.tip(fresh) - TrueArm(arm, [hidden]).tip(fresh)
        left.append(float(np.linalg.norm(apart, axis=1).mean()))
    assert left[0] < 0.5 * left[1]


def test_advice_goes_by_the_drive() -> None:
    arm = boom()
    assert "pins and bushes" in Backlash(joint=2).advice(arm)
    assert Backlash(joint=1).advice(arm) == Backlash.action
    assert DhError(row=2).advice(arm) == DhError.action
