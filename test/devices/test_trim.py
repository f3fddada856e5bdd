"""Trim: readings brought to where joints were sent, bounded, and never after a wrong encoder."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from follower_rig import CONFIG, DT, LIMITS, TURN, Rig, kinds
from places import ROOT

from longarm_comp.core.data.plan import sobol
from longarm_comp.devices.follower_report import EventKind, Step
from longarm_comp.devices.servo_follower import TrajectoryFollower
from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec
from studies.readings import SaggingArm

Reading = Callable[[float], float]
DROOP = 18.0
DRIVER_S = 0.05
CONFIGS = ROOT / "config"


class Sagging(Rig):
    """The turning joint is a real motor under load; what its encoder says may be another thing."""

    def __init__(self, spec: MotorSpec, trim: bool = True) -> None:
        self.motor = Motor(spec, TURN.to_ticks(0.2))
        self.motor.switch(True)
        self.motor.external_load = -0.3
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


def test_corrections_are_as_far_apart_as_the_arm_has_to_rest() -> None:
    rig, pause_s = Sagging(STICKS), 0.5
    limits = CONFIG.follower.model_copy(update={"trim_pause_s": pause_s})
    rig.follower = TrajectoryFollower(CONFIG.model_copy(update={"follower": limits}), trim=True)
    rig.step()
    rig.says = lambda ticks: min(ticks, TURN.to_ticks(0.5) - 30.0)  # no correction helps
    rig.send((1.0, {"turn": 0.5}))
    corrected, last, end = [], rig.follower.trim_by_joint, rig.now + 6.0
    while rig.now < end:
        rig.step()
        if rig.follower.trim_by_joint != last:
            corrected.append(rig.now)
            last = rig.follower.trim_by_joint
    assert len(corrected) > 1 and np.diff(corrected).min() >= pause_s


def test_the_next_move_starts_with_what_the_last_one_found() -> None:
    rig = Sagging(SAGS)
    first, second = rig.move(0.5), rig.move(0.55)
    assert took(second) < took(first)
    assert abs(rig.off(0.55)) <= 1.0


@pytest.mark.parametrize("seconds", [225.0, pytest.param(3600.0, marks=pytest.mark.long)])
def test_an_hour_of_moves_without_hunting(seconds: float) -> None:
    """Trimmed once: from rest to the next move no goal changes, though encoder and load flicker."""
    rng, rig = np.random.default_rng(7), Sagging(STICKS)
    begun, steps_at_rest, off = rig.now, 0, []
    rig.says = lambda ticks: ticks + rng.integers(0, 2)
    while rig.now - begun < seconds:
        q = float(rng.uniform(0.9 * TURN.lower, 0.9 * TURN.upper))
        rig.send((1.0, {"turn": q}))
        rig.motor.external_load = float(rng.uniform(-0.35, 0.35))
        end: set[EventKind] = set()
        while not end & {EventKind.ARRIVED, EventKind.SHORT}:
            end = {e.kind for e in rig.step(DRIVER_S).events}
        assert EventKind.ARRIVED in end
        goal = rig.motor.goal
        off.append(rig.off(q))
        for _ in range(60):
            rig.step(DRIVER_S)
            steps_at_rest += rig.motor.goal != goal
            goal = rig.motor.goal
    assert len(off) > seconds / 7.2
    assert steps_at_rest == 0
    assert np.mean(np.abs(off)) < 1.0


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
def sagging_arm(tmp_path: Path) -> Iterator[SaggingArm]:
    """Servos that give way by 8 mm at the tip, with play of friction."""
    with closing(SaggingArm(CONFIGS, tmp_path, trim=True)) as made:
        yield made


def test_a_droop_of_millimetres_is_trimmed_to_a_tenth(sagging_arm: SaggingArm) -> None:
    """Without any droop in a model: the tip stands where a sound arm's would."""
    arm, off = sagging_arm.arm, []
    for q in np.round(sobol(arm, 4, np.random.default_rng(2)).q[1:3] / arm.steps) * arm.steps:
        assert sagging_arm.move(q).kind is EventKind.ARRIVED
        off.append(sagging_arm.miss(q))
    assert max(off) < 2e-4
    assert np.mean(off) < 1e-4
    assert any(abs(v) > 40 for v in sagging_arm.driver.follower.trim_by_joint.values())


def test_a_trimmed_joint_stands_where_its_encoder_says(tmp_path: Path) -> None:
    """In bytes: the encoder's zero is what is left."""
    with closing(SaggingArm(CONFIGS, tmp_path, trim=True, off=7.0)) as rig:
        q = np.round(rig.arm.mid / rig.arm.steps) * rig.arm.steps
        assert rig.move(q).kind is EventKind.ARRIVED
        left = np.abs(rig.plant.joints() - q) / rig.arm.steps
    assert left == pytest.approx(np.full(rig.arm.n, 7.0), abs=0.6)


@pytest.mark.parametrize(
    ("follows", "jump", "end"),
    [
        pytest.param(0.0, 0.0, EventKind.SHORT, marks=pytest.mark.long),  # frozen
        (0.4, 0.0, EventKind.ARRIVED),  # slips: nobody can know
        pytest.param(1.0, 30.0, EventKind.ARRIVED, marks=pytest.mark.long),  # jumped
        (1.0, 120.0, EventKind.SHORT),
    ],
)
def test_a_wrong_encoder_on_the_bus_moves_the_joint_no_farther_than_the_bound(
    sagging_arm: SaggingArm, follows: float, jump: float, end: EventKind
) -> None:
    """One that asks for more is told, and what was done for it is undone."""
    rig, arm = sagging_arm, sagging_arm.arm
    joint = arm.joint_names.index("joint4")
    tick = rig.driver.config.joints["joint4"].si_per_tick
    servo, bound = rig.driver.config.ids["joint4"], LIMITS.trim_ticks
    q = np.round(arm.mid / arm.steps) * arm.steps
    assert rig.move(q).kind is EventKind.ARRIVED
    with rig.plant.emulator.motor(servo) as motor:
        motor.follows, motor.seen = follows, motor.seen + jump
    goal, farthest = q + 30 * tick * np.eye(arm.n)[joint], 0.0

    def watch() -> None:
        nonlocal farthest
        farthest = max(farthest, (rig.plant.joints() - goal)[joint] / tick, key=abs)

    said = rig.move(goal, watch)
    assert said.kind is end
    assert 10.0 < abs(farthest) <= bound
    if end is EventKind.SHORT:
        assert "joint4 by" in said.message and "of trim" in said.message
        for _ in range(50):
            rig.cycle()
        assert rig.driver.follower.trim_by_joint["joint4"] == 0.0
