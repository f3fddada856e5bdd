"""The real graph commands an arm with play, droop and friction: does its own tip arrive?

The model holds what the simulated arm hides, so that only the way from target to tip is judged:
the circumstances that a command is computed for must be those that the arm arrives in.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from geometry_msgs.msg import PointStamped
from simulated_graph import simulated_graph
from target_requests import pose

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.calibration.calibrate import declared_model
from longarm_comp.core.effects.compliances import ServoDroop
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis, ServoDeadband
from longarm_comp.core.effects.typical_loads import typical_loads
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import folder
from longarm_comp.nodes.clock import stamp_ns
from longarm_comp.nodes.messages import joints_of
from longarm_comp.nodes.simulated_arm import sizes
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import drives
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.plant import hidden_effects
from longarm_comp.sim.servo_emulator.joints import read_arm
from longarm_comp.sim.servo_emulator.motor import MotorSpec
from longarm_interfaces.srv import Compensate

SEED = 3
MODEL_M = 3e-5
"""What model, search and rods differ by (`docs/physics.md`), and the servos' settling."""
TRIED = 200
"""Targets that are drawn; a tenth of them would do."""


@dataclass
class Stage:
    """The graph, what the simulated arm hides, and the model that kinematics has of it."""

    arm: Arm
    hidden: tuple[HiddenEffect, ...]
    model: Model
    client: ArmClient
    truth: list[tuple[int, np.ndarray]] = field(default_factory=list)
    at: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        self.compensate = graph.COMPENSATE.client(self.client.node)
        self.client.node.create_subscription(
            PointStamped, "simulated_arm/true_tip", self._on_truth, 20
        )
        self.steps = np.array(
            [abs(j.travel) for j in read_arm(folder("config") / "servo_driver.yaml").joints]
        )
        self.turning = np.array(
            [self.arm.joints[r - 1].type == "revolute" for r in self.arm.commanded]
        )

    def _on_truth(self, message: PointStamped) -> None:
        p = message.point
        self.truth.append((stamp_ns(message.header.stamp), np.array([p.x, p.y, p.z])))
        del self.truth[:-20]

    def ask(self, target: np.ndarray, *, whole: bool, execute: bool) -> Compensate.Response:
        """Joints for the pose (4, 4), or for its position alone."""
        request = Compensate.Request(target=pose(target), position_only=not whole, execute=execute)
        return self.client.call(self.compensate, request, again=not execute)

    def ready(self) -> None:
        """Wait until kinematics knows the joints and hears the driver's commands."""
        self.client.ready(120.0, tip=False)
        target = declared_model(self.arm).pose(self.arm.mid)
        self.client.until(
            lambda: (
                self.ask(target, whole=False, execute=False).status != Compensate.Response.NOT_READY
            ),
            120.0,
            "kinematics is not ready",
        )

    def rest(self, path: np.ndarray, start: np.ndarray | None) -> int:
        """Wait until the arm, sent from ``start``, rests at the end of a path (k, n); when, ns."""
        pace = Pace(dwell_s=0.2, tolerance=np.where(self.turning, 3e-4, 3e-5))
        self.at = path[-1]
        return self.client.arrive(path, pace, start)

    def go(self, q: np.ndarray) -> None:
        """Command joints (n,) and wait."""
        start = self.client.joints
        self.client.send(q[None], 0.05)
        self.client.spin(0.05)
        self.rest(q[None], start)

    def reach(self, target: np.ndarray, *, whole: bool) -> np.ndarray:
        """Command a target; by how much the true tip misses it, (3,) m."""
        start = self.client.joints
        answer = self.ask(target, whole=whole, execute=True)
        assert answer.success, answer.message
        self.client.spin(0.05)
        rest = self.rest(self.path(answer), start) + 100_000_000

        def settled() -> bool:
            """The servos have given way to the load of this posture: pictures that agree."""
            last = [tip for ns, tip in self.truth if ns > rest][-4:]
            return len(last) == 4 and float(np.ptp(last, axis=0).max()) < 1e-6

        self.client.until(settled, 300.0, "no true_tip at rest")
        return self.truth[-1][1] - target[:3, 3]

    def path(self, answer: Compensate.Response) -> np.ndarray:
        """Way-points (k, n) of an answer."""
        stops = [answer.run_up, answer.command] if answer.run_up.name else [answer.command]
        return np.array([joints_of(stop, self.arm, "compensate") for stop in stops])

    def tolerance(self, q: np.ndarray) -> float:
        """The most (m) that servos on whole steps, and the model's physics, can miss at joints."""
        each = np.diag(self.steps)
        lever = (self.model.tip(q + each) - self.model.tip(q - each)) / 2.0
        return 0.5 * float(np.linalg.norm(lever, axis=1).sum()) + MODEL_M

    def clear_of_the_gates(self, q: np.ndarray) -> bool:
        """Whether every load is so far from each gate that its side is beyond doubt."""
        loads = np.abs(TrueArm(self.arm, self.hidden, steps=2).settle(q[None]).torques[0])
        gates = [getattr(e, "gate", 0.0) for e in self.hidden]
        return all((np.abs(loads[self.turning] / gate - 1.0) > 0.2).all() for gate in gates if gate)


def known(arm: Arm, hidden: tuple[HiddenEffect, ...]) -> Model:
    """The declared arm with what it hides, in the words of the library."""
    torque = typical_loads(arm).torque
    reach = MotorSpec().wind_up_ticks * 2 * np.pi / 40960  # geared 10 to 1
    sharp = 0.01  # the simulated gates are sharp
    terms: list[Effect] = []
    for j, row in enumerate(arm.commanded):
        if arm.joints[row - 1].type == "revolute":
            for e in hidden:
                if isinstance(e, drives.Backlash):
                    width = 2 * e.half[j]
                    terms.append(Backlash(row, gate=e.gate / torque, blend=sharp, width=width))
                elif isinstance(e, drives.ServoDroop):
                    terms.append(ServoDroop(row, compliance=e.compliance[j]))
                elif isinstance(e, drives.ServoDeadband):
                    terms.append(ServoDeadband(row, e.gate / torque, sharp, width=2 * e.half[j]))
                elif isinstance(e, drives.FrictionMemory):
                    width = 2 * e.lag[j]  # all of it remembered, nothing by the side alone
                    terms.append(FrictionHysteresis(row, far=reach, width=width, outer=width))
    return declared_model(arm).plus(*terms)


@contextlib.contextmanager
def commanded(arm_path: Path, hidden: str, tmp_path: Path) -> Iterator[Stage]:
    """The graph of a simulated arm, and a client on it."""
    arm = Arm.load(arm_path)
    made = hidden_effects(arm, sizes(hidden), np.random.default_rng(SEED))
    model = known(arm, made)
    save_model(tmp_path / "model.yaml", store(model))
    with simulated_graph(
        arm_path, {"move_time_s": 0.05}, model=tmp_path / "model.yaml", speed=20.0,
        tips=graph.TIP_MEASURED, servo_driver={"follower.blend_s": 0.05},
        simulated_arm={"hidden": hidden, "seed": SEED, "frame_rate_hz": 10.0},
    ) as client:  # fmt: skip
        stage = Stage(arm, made, model, client)
        stage.ready()
        yield stage


def test_play_and_droop_whatever_side_the_joints_come_from(
    ros_domain: int, demo_arm_path: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    sides, run_ups = [], 0
    # Where a load is within its friction, a servo rests anywhere in its deadband: keep that small
    with commanded(
        demo_arm_path, "backlash=2.0 servo_droop=1.0 servo_deadband=0.3", tmp_path
    ) as stage:
        arm = stage.arm
        for _ in range(TRIED):
            if len(sides) == 12:
                break
            target = stage.model.pose(rng.uniform(arm.lower, arm.upper))
            answer = stage.ask(target, whole=False, execute=False)
            if not (answer.success and stage.clear_of_the_gates(stage.path(answer)[-1])):
                continue
            missed = float(np.linalg.norm(stage.reach(target, whole=False)))
            assert missed < stage.tolerance(stage.at), answer
            sides.append(list(answer.approach))
            run_ups += bool(answer.run_up.name)
    assert len(sides) == 12, answer
    each = np.array(sides)[:, stage.turning]
    both = (each == 1).any(axis=0) & (each == -1).any(axis=0)
    assert both.sum() >= 3  # a joint whose load is always of one sign arrives against it
    assert run_ups


@pytest.mark.long
def test_friction_that_remembers_the_move_before(
    ros_domain: int, demo_arm_path: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    hidden = "backlash=2.0 servo_droop=1.0 servo_deadband=0.5 friction_memory=2.0"
    done = part_wound = 0
    with commanded(demo_arm_path, hidden, tmp_path) as stage:
        arm = stage.arm
        span, reach = arm.upper - arm.lower, 0.1
        for _ in range(TRIED):
            if done == 8:
                break
            # wound up to one side each, by a move of more than twice the reach
            side = rng.choice([-1.0, 1.0], arm.n)
            start = arm.lower + span * rng.uniform(0.4, 0.6, arm.n)
            stage.go(start - 0.39 * side * span)
            stage.go(start)
            for _ in range(20):
                way = rng.choice([-1.0, 1.0], arm.n) * rng.uniform(0.1, 0.25, arm.n) * span
                target = stage.model.pose(start + way)
                answer = stage.ask(target, whole=True, execute=False)
                if not answer.success:
                    continue
                (q, *_) = reversed(stage.path(answer))
                step = (q - start)[stage.turning]
                turned = step * side[stage.turning] < 0
                # a run-up against the move before unwinds what the record does not count
                exact = ~turned | (np.abs(step) >= run_up_lengths(arm)[stage.turning])
                if exact.all() and stage.clear_of_the_gates(q):
                    break
            else:
                continue
            missed = float(np.linalg.norm(stage.reach(target, whole=True)))
            assert missed < stage.tolerance(q), answer
            part_wound += int((turned & (np.abs(step) < 1.5 * reach)).sum())
            done += 1
    assert done == 8, answer
    assert part_wound >= 5
