"""The trajectory follower of two servos with a fake clock, and what it has said."""

from dataclasses import replace
from typing import Any

import numpy as np

from longarm_comp.devices.follower_report import EventKind, Step
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint
from longarm_comp.devices.servo_bus.state import ServoAlarm, ServoState
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_follower import KeepsOut, Shapes, TrajectoryFollower

DT = 0.02
CONFIG = ServoConfig.parse(
    {
        "bus": {"protocol": "feetech", "port": "/dev/null"},
        "joints": {
            "turn": {
                "servo_id": 5,
                "model": "sts3215",
                "type": "revolute",
                "zero_ticks": 2048,
                "lower": -1.0,
                "upper": 1.0,
                "max_velocity": 0.8,
            },
            "slide": {
                "servo_id": 9,
                "model": "sts3215",
                "type": "prismatic",
                "pinion_radius_m": 0.018,
                "zero_ticks": 4000,
                "direction": -1,
                "lower": 0.0,
                "upper": 0.1,
                "max_velocity": 0.05,
            },
        },
    },
    "test",
)
TURN, SLIDE = CONFIG.joints.values()
LIMITS = CONFIG.follower


def servo_state(ticks: int, **changes: Any) -> ServoState:
    """A healthy servo at rest, but for the changes."""
    return replace(ServoState(ticks, 0.0, 0.0, 7.4, 30.0, ServoAlarm.NONE), **changes)


class Rig:
    """A follower on servos that go where they are told within one step."""

    def __init__(
        self,
        config: ServoConfig = CONFIG,
        keeps_out: KeepsOut | None = None,
        shapes: Shapes | None = None,
    ) -> None:
        self.config = config
        self.follower = TrajectoryFollower(config, keeps_out, shapes)
        self.now = 100.0
        self.states = {5: servo_state(TURN.to_ticks(0.2)), 9: servo_state(SLIDE.to_ticks(0.03))}
        self.obeys = {5, 9}
        self.trace: list[dict[str, float]] = []
        self.step()

    def step(self, dt: float = DT, hide: tuple[int, ...] = ()) -> Step:
        self.now += dt
        step = self.follower.step(self.now, {i: s for i, s in self.states.items() if i not in hide})
        for servo_id in self.obeys & set(step.goals or ()):
            assert step.goals is not None
            goal = step.goals[servo_id]
            self.states[servo_id] = replace(self.states[servo_id], position_ticks=goal)
        self.trace.append(step.set_points)
        return step

    def send(self, *points: tuple[float, dict[str, float]]) -> None:
        names = tuple(points[0][1])
        self.follower.accept(
            JointTrajectory(
                names, tuple(TrajectoryPoint(t, tuple(q[n] for n in names)) for t, q in points)
            ),
            self.now,
        )

    def run(self, seconds: float, **kwargs: Any) -> list[Step]:
        return [self.step(**kwargs) for _ in range(round(seconds / DT))]

    def column(self, name: str) -> np.ndarray:
        return np.array([s[name] for s in self.trace if s])


def kinds(steps: list[Step]) -> list[EventKind]:
    """What happened in these steps, in order."""
    return [event.kind for step in steps for event in step.events]
