"""Trim: readings brought to where joints were sent, bounded, and never after a wrong encoder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from follower_rig import CONFIG, DT, LIMITS, TURN, Rig, kinds

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_follower import EventKind, Step, TrajectoryFollower
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.cameras import CameraPair, tag_plate
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.drives import ServoDroop
from longarm_comp.sim.plant import Plant, PlantConfig, mounting
from longarm_comp.sim.servo_emulator import Motor, MotorSpec, read_arm

Reading = Callable[[float], float]
DROOP = 18.0


class Sagging(Rig):
    """The turning joint is a real motor under load; what its encoder says may be another thing."""

    def __init__(self, spec: MotorSpec, load: float = -0.3, trim: bool = True) -> None:
        self.motor = Motor(spec, TURN.to_ticks(0.2))
        self.motor.switch(True)
        self.motor.external_load = load
        self.says: Reading = lambda ticks: ticks
        super().__init__()
        self.obeys = {9}
        self.follower = TrajectoryFollower(CONFIG, trim=trim)
        self.step()

    def step(self, dt: float = DT, hide: tuple[int, ...] = ()) -> Step:
        made = super().step(dt, hide)
        if made.goals:
            self.motor.goal = made.goals[5]
        self.motor.advance(dt)
        self.states[5] = replace(
            self.states[5],
            position_ticks=round(self.says(self.motor.position)),
            velocity_ticks_s=self.motor.velocity,
        )
        return made

    def move(self, value: float, seconds: float = 3.0, points: int = 1) -> list[Step]:
        """Send the joint somewhere, by so many points; what was stepped until then."""
        start = self.follower.set_points.get("turn", 0.2)
        way = [start + (value - start) * (k + 1) / points for k in range(points)]
        self.send(*((1.0 + k / points, {"turn": q}) for k, q in enumerate(way)))
        return self.run(seconds)

    def off(self, value: float) -> float:
        """True place less wanted place, ticks."""
        return self.motor.position - TURN.to_ticks(value)


SAGS = MotorSpec(droop_ticks=60.0)
STICKS = MotorSpec(droop_ticks=60.0, dead_band_ticks=4.0, hold_share=0.05)


def took(steps: list[Step]) -> float:
    """Time until it arrived, s."""
    return DT * next(k for k, s in enumerate(steps) if EventKind.ARRIVED in kinds([s]))


def test_without_trim_the_joint_hangs_below_its_goal() -> None:
    rig = Sagging(SAGS, trim=False)
    assert EventKind.ARRIVED in kinds(rig.move(0.5))
    assert rig.off(0.5) == pytest.approx(-DROOP, abs=0.5)


@pytest.mark.parametrize("spec", [SAGS, STICKS])
@pytest.mark.parametrize("value", [0.5, -0.3])
def test_trim_brings_it_to_its_goal(spec: MotorSpec, value: float) -> None:
    """From either side, through a deadband and friction, in less than 0.6 s more."""
    rig, without = Sagging(spec), Sagging(spec, trim=False)
    steps, plain = rig.move(value), without.move(value)
    assert abs(rig.off(value)) <= 1.0
    assert took(steps) - took(plain) <= 0.6


def test_the_next_move_starts_with_what_the_last_one_found() -> None:
    rig = Sagging(SAGS)
    first, second = rig.move(0.5), rig.move(0.55)
    assert took(second) < took(first)
    assert abs(rig.off(0.55)) <= 1.0


def test_it_stands_still_afterwards() -> None:
    """No hunting, also where the encoder flickers by a tick for an hour of cycles."""
    rig = Sagging(STICKS)
    rig.move(0.5)
    at, tick = rig.motor.position, [0.0]

    def flickers(ticks: float) -> float:
        tick[0] = 1.0 - tick[0]
        return ticks + tick[0]

    rig.says = flickers
    rig.run(3600.0 / 50)
    assert rig.motor.position == at


@pytest.mark.parametrize(
    "says",
    [
        lambda ticks: TURN.to_ticks(0.5) - 30,  # frozen just short
        lambda ticks: TURN.to_ticks(0.5) - 0.9 * LIMITS.stall_error_ticks,
        lambda ticks: TURN.to_ticks(0.5) + 25,
    ],
)
def test_a_frozen_encoder_moves_it_no_farther_than_the_bound(says: Reading) -> None:
    """And it is told, and what was done is undone."""
    rig = Sagging(MotorSpec(droop_ticks=0.0))
    rig.send((1.0, {"turn": 0.5}))
    steps, farthest = rig.run(1.1), 0.0
    rig.says = says
    for _ in range(150):
        steps.append(rig.step())
        farthest = max(farthest, abs(rig.off(0.5)))
    assert 1.0 < farthest <= LIMITS.trim_ticks
    assert abs(rig.off(0.5)) <= 1.0
    told = [e for s in steps for e in s.events if e.kind is EventKind.SHORT]
    assert len(told) == 1
    assert "turn by" in told[0].message and "of trim" in told[0].message


def test_an_encoder_that_slips_as_it_is_trimmed_stays_within_the_bound() -> None:
    """Each motion loses half: the joint follows twice as far as the reading."""
    rig = Sagging(MotorSpec(droop_ticks=0.0))
    rig.move(0.5, 1.6)
    begin = rig.motor.position
    rig.says = lambda ticks: begin - 90 + 0.5 * (ticks - begin)
    rig.move(0.501)
    assert abs(rig.off(0.501)) <= LIMITS.trim_ticks


def test_a_path_is_not_trimmed_and_leaves_nothing_of_the_last_trim() -> None:
    rig = Sagging(SAGS)
    rig.move(0.5)
    rig.move(0.3, points=5)
    assert rig.off(0.3) == pytest.approx(-DROOP, abs=0.5)


def test_it_does_not_push_a_joint_at_its_limit_or_one_that_is_stalled() -> None:
    rig = Sagging(SAGS)
    assert EventKind.ARRIVED in kinds(rig.move(TURN.upper))
    assert rig.motor.goal == TURN.tick_limits[1]
    rig = Sagging(SAGS)
    rig.states[5] = replace(rig.states[5], load=TURN.max_load)
    rig.move(0.5)
    assert rig.motor.goal == TURN.to_ticks(0.5)


# ------------------------------------------------------------------ the whole arm, on its bus


@pytest.fixture
def sagging_arm(tmp_path: Path) -> Iterator[tuple[Arm, Plant, ServoArm]]:
    """The demonstration arm whose servos give way by 8 mm at the tip, with play of friction."""
    config = Path(__file__).parent.parent / "config"
    arm = Arm.load(config / "arm_demo_steps.yaml")
    data = read_yaml(config / "servo_driver.yaml")["/**/servo_driver"]["ros__parameters"]
    data["bus"]["port"] = str(tmp_path / "bus")
    servos = ServoConfig.parse({k: data[k] for k in ("bus", "joints", "follower")}, "demo")
    turns = np.array([float(j.type == "revolute") for j in arm.joints])
    plant = Plant(
        PlantConfig(
            arm,
            read_arm(config / "servo_driver.yaml"),
            CameraPair(position_m=(0.75, -1.7, 0.3), optical_axis=(0.0, 1.0, 0.0)),
            tag_plate(0.06, 0.012, 2, 2),
            mounting([0.0, 0.0, 0.0]),
            (ServoDroop(2e-3 * turns, 3e-4 * turns, 0.05),),
        ),
        tmp_path / "bus",
        np.random.default_rng(1),
    )
    plant.start()
    driver = ServoArm(servos, trim=True)
    driver.power(True)
    yield arm, plant, driver
    driver.close()
    plant.stop()


def test_a_droop_of_millimetres_is_trimmed_to_a_tenth(
    sagging_arm: tuple[Arm, Plant, ServoArm],
) -> None:
    """Without any droop in a model: the tip stands where a sound arm's would."""
    arm, plant, driver = sagging_arm
    sound = TrueArm(arm, (), steps=2)
    off = []
    for q in np.round(sobol(arm, 4, np.random.default_rng(2)).q[1:] / arm.steps) * arm.steps:
        driver.cycle(time.monotonic())
        points = (TrajectoryPoint(1.0, tuple(q)),)
        driver.accept(JointTrajectory(arm.joint_names, points), time.monotonic())
        said: set[EventKind] = set()
        while not said & {EventKind.ARRIVED, EventKind.SHORT, EventKind.FAULT}:
            said |= {e.kind for e in driver.cycle(time.monotonic()).step.events}
            plant.tip_pose(0.0)
        assert EventKind.ARRIVED in said
        want = sound.tip(q, TrueContext(payload_kg=0.0)).ravel()
        off.append(float(np.linalg.norm(plant.tip_pose(0.0)[:3, 3] - want)))
    assert max(off) < 2e-4
    assert np.mean(off) < 1e-4
    assert any(abs(v) > 40 for v in driver.follower.trimmed.values())
