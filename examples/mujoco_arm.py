"""An arm that another program drives: five joints in MuJoCo, on the topics of longarm_comp's graph.

python examples/mujoco_arm.py --seed 1

It hears `joint_trajectory`, and publishes `joint_states` and `tip_measured` (a tracker with noise).
Nothing here is of longarm_comp. `mujoco_arm.yaml` is what its owner declares; the arm itself has,
drawn by the seed, an elastic hinge behind every drive, servos that give way, and zeros, lengths,
axes, masses and tubes that are a little off. docs/mujoco.md tells the way on.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import mujoco
import numpy as np

JOINTS = ("slew", "shoulder", "elbow", "wrist", "roll")
PLACES = ((0, 0, 0.6), (0.1, 0, 0), (1.3, 0, 0), (1.0, 0, 0), (0.15, 0, 0))  # m, on the part before
AXES = ("0 0 1", "0 -1 0", "0 -1 0", "0 -1 0", "1 0 0")
DRIVES_KG = (30.0, 6.0, 4.0, 1.5, 1.0)
TUBES = {1: (1.3, 0.060, 0.052), 2: (1.0, 0.045, 0.039)}  # behind a joint: length, diameters, m
TIP = (0.20, 0.06, 0.0)
HOSE = 40.0, 0.9, "-0.1 0.1 1.1"  # from the column to the forearm: N/m, free length, foot
SPEED = np.array([0.8, 0.5, 0.8, 1.5, 2.0])  # rad/s
NOISE_M = 1e-4  # of a sighting, along each axis
STEP_S, PIECES = 0.002, 4  # of the simulation; elastic pieces of a tube


def drawn(seed: int, hose: bool) -> str:
    """The MJCF of one arm: the drawing (above) with errors of its own."""
    rng = np.random.default_rng(seed)
    soft = rng.uniform(1.0, 2.0, 5) * (2e4, 3e4, 8e3, 2e3, 1e3)  # N m/rad, behind the drives
    servo = soft * rng.uniform(15.0, 30.0, 5)
    young = 6.9e10 * rng.normal(1.0, 0.03, 5)
    weigh = rng.uniform(0.9, 1.1, 10)
    body, actuators, before = "", "", 0.0
    for i, (name, place, axis) in enumerate(zip(JOINTS, PLACES, AXES, strict=True)):
        at = np.array(place) - (before, 0, 0) + rng.normal(0.0, 1e-3, 3)
        tilt = rng.normal(0.0, 2e-3, 3)
        body += (
            f'<body pos="{at[0]} {at[1]} {at[2]}" euler="{tilt[0]} {tilt[1]} {tilt[2]}">'
            f'<joint name="{name}" axis="{axis}" armature="{servo[i] / 1e4}"/>{weight(0.2)}<body>'
            f"{hinge(axis, soft[i])}{weight(DRIVES_KG[i] * weigh[i], *(0.1, 0.02)[: 2 * (i == 4)])}"
            f'<geom size="{0.08 - 0.01 * i}" rgba="0.2 0.4 0.7 1"/>'
        )
        actuators += f'<position joint="{name}" kp="{servo[i]}" dampratio="1"/>'
        length, outer, inner = TUBES.get(i, (0.0, 0.0, 0.0))
        piece = length / PIECES
        stiff = young[i] * np.pi / 64 * (outer**4 - inner**4) / max(piece, 1e-9)  # EI / length
        kg = 2700 * np.pi / 4 * (outer**2 - inner**2) * piece * weigh[5 + i]
        for k in range(PIECES if length else 0):  # each hangs at its middle on two hinges
            body += (
                f'<body pos="{piece if k else piece / 2} 0 0">{hinge("0 1 0", stiff)}'
                f'{hinge("0 0 1", stiff)}{weight(kg)}<geom type="capsule" size="{outer / 2}" '
                f'fromto="{-piece / 2} 0 0 {piece / 2} 0 0" rgba="0.75 0.77 0.8 1"/>'
                f'<site name="{name}{k}"/>'
            )
        before = length - piece / 2
    x, y, z = np.array(TIP) + rng.normal(0.0, 1e-3, 3)
    body += '<geom type="capsule" size="0.015" fromto="-0.15 0 0 0 0 0" rgba="0.75 0.77 0.8 1"/>'
    body += f'<geom type="capsule" size="0.012" fromto="0 0 0 {x} {y} {z}" rgba="0.8 0.3 0.2 1"/>'
    body += f'<site name="tip" pos="{x} {y} {z}"/>' + "</body>" * (10 + PIECES * len(TUBES))
    tendon = (
        f'<tendon><spatial stiffness="{HOSE[0]}" damping="2" springlength="0 {HOSE[1]}">'
        '<site site="foot"/><site site="elbow1"/></spatial></tendon>'
    )
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{STEP_S}" integrator="implicitfast">'
        '<flag contact="disable"/></option><visual><global offwidth="1200" offheight="900"/>'
        '<headlight ambient="0.4 0.4 0.4" diffuse="0.5 0.5 0.5"/></visual><asset><texture '
        'type="skybox" builtin="flat" rgb1="1 1 1" width="8" height="48"/></asset><worldbody>'
        '<light pos="2 -3 5" dir="-0.3 0.5 -1" diffuse="0.4 0.4 0.4"/>'
        '<geom type="plane" size="3 3 0.1" rgba="0.93 0.93 0.9 1"/>'
        '<geom type="cylinder" size="0.09" fromto="0 0 0 0 0 0.55" rgba="0.3 0.3 0.33 1"/>'
        f'<site name="foot" group="4" pos="{HOSE[2]}"/>{body}</worldbody>'
        f"<actuator>{actuators}</actuator>{tendon if hose else ''}</mujoco>"
    )


def hinge(axis: str, stiffness: float) -> str:
    """An elastic hinge, N m/rad, whose swing dies within a second."""
    swing = f'damping="{0.03 * stiffness}" armature="{stiffness / 1e5}"'
    return f'<joint axis="{axis}" stiffness="{stiffness}" {swing}/>'


def weight(kg: float, along: float = 0.0, up: float = 0.0) -> str:
    """A compact mass at a place (m) of its part."""
    inertia = " ".join([str(kg * 1e-3)] * 3)
    return f'<inertial pos="{along} 0 {up}" mass="{kg}" diaginertia="{inertia}"/>'


class RealArm:
    """The arm. Joints (5,), rad, are the controller's: the real zeros are off by some 0.3 deg."""

    def __init__(self, seed: int, hose: bool = False) -> None:
        self.model = mujoco.MjModel.from_xml_string(drawn(seed, hose))
        self.data = mujoco.MjData(self.model)
        self._zero = np.random.default_rng([seed, 1]).normal(0.0, np.radians(0.3), len(JOINTS))
        self._motors = [self.model.joint(name).qposadr[0] for name in JOINTS]
        self._rest()

    @property
    def tip(self) -> np.ndarray:
        """(3,) m, where the tip truly is."""
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.site("tip").xpos.copy()

    @property
    def joints(self) -> np.ndarray:
        """(5,) rad, as the encoders of the motors tell them."""
        return self.data.qpos[self._motors] - self._zero

    def move(self, path: Iterable[np.ndarray]) -> Iterator[None]:
        """Go through joints (k, 5), and come to rest; each turn is 0.02 s."""
        for goal in path:
            start, end = self.data.ctrl.copy(), np.asarray(goal) + self._zero
            turns = 2 + int(np.max(np.abs(end - start) / SPEED) * 1.5 / 0.02)
            for share in np.arange(1, turns + 1) / turns:
                self.data.ctrl[:] = start + share**2 * (3 - 2 * share) * (end - start)
                mujoco.mj_step(self.model, self.data, round(0.02 / STEP_S))
                yield
        self._rest()

    def _rest(self) -> None:
        for _ in range(20):
            mujoco.mj_step(self.model, self.data, round(0.5 / STEP_S))
            if np.abs(self.data.qvel).max() < 1e-6:
                break


def serve(arm: RealArm, seed: int, speed: int, log: Path | None) -> None:
    """Be on the graph until Ctrl-C; ``speed`` times as fast. ``log``: true rests, a CSV."""
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.executors import ExternalShutdownException
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    rclpy.init()
    node = rclpy.create_node("mujoco_arm")
    states = node.create_publisher(JointState, "joint_states", 10)
    tips = node.create_publisher(PoseWithCovarianceStamped, "tip_measured", 10)
    rng = np.random.default_rng([seed, 2])
    ahead: list[Iterator[None]] = []
    goal: list[np.ndarray] = []

    def take(message: JointTrajectory) -> None:
        order = [message.joint_names.index(name) for name in JOINTS]
        goal[:] = [np.array(point.positions)[order] for point in message.points]
        ahead[:] = [arm.move(goal.copy())]  # no points: it stops where it is

    def turn() -> None:
        for _ in range(speed if ahead else 0):
            if next(ahead[0], "over") == "over":
                ahead.clear()
                if goal and log is not None:
                    with log.open("a", newline="") as file:
                        csv.writer(file).writerow([*goal[-1], *arm.tip])
                break
        now = node.get_clock().now().to_msg()
        state = JointState(name=JOINTS, position=arm.joints.tolist())
        seen = PoseWithCovarianceStamped()
        state.header.stamp = seen.header.stamp = now
        seen.header.frame_id = "base"
        at = seen.pose.pose.position
        at.x, at.y, at.z = (arm.tip + rng.normal(0.0, NOISE_M, 3)).tolist()
        seen.pose.covariance = np.diag([NOISE_M**2] * 3 + [0.0] * 3).ravel().tolist()
        states.publish(state)
        if not ahead:  # a tracker tells no position while the reflector moves
            tips.publish(seen)

    node.create_subscription(JointTrajectory, "joint_trajectory", take, 10)
    node.create_timer(0.02, turn)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=1, help="which arm")
    parser.add_argument("--hose", action="store_true", help="a hose pulls, which nobody declared")
    parser.add_argument("--speed", type=int, default=1, help="of its time")
    parser.add_argument("--log", type=Path, help="file to add the true tip of every rest to")
    given = parser.parse_args()
    serve(RealArm(given.seed, given.hose), given.seed, given.speed, given.log)
