"""What the servo driver publishes: readings, what became of a trajectory, health of the bus."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from builtin_interfaces.msg import Time
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectoryPoint

from longarm_comp.devices.servo_arm import Cycle, ServoReading
from longarm_comp.devices.servo_bus import SerialServoBus
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_follower import Accepted
from longarm_comp.nodes.health import ERROR, OK, Report
from longarm_comp.nodes.messages import duration
from longarm_interfaces.msg import Motion


def readings_message(readings: Mapping[str, ServoReading], stamp: Time) -> JointState:
    """The last read-back; empty where a servo was silent."""
    message = JointState(
        name=list(readings),
        position=[joint.position for joint in readings.values()],
        velocity=[joint.velocity for joint in readings.values()],
        effort=[joint.effort for joint in readings.values()],
    )
    if all(map(math.isnan, message.effort)):
        message.effort = []  # of no joint is it known
    message.header.stamp = stamp
    return message


def motion_message(
    name: str,
    event: int,
    why: str,
    joints: JointState,
    taken: Accepted | None,
    names: Sequence[str],
) -> Motion:
    """What became of the trajectory of that id, and where the joints are.

    Args:
        name: id. event: as `Motion` lists them. why: in words.
        joints: read-back with the time of the event.
        taken: start and way-points, where it was accepted now.
        names: of the joints.
    """
    message = Motion(id=name, event=event, message=why, joints=joints)
    message.header.stamp = joints.header.stamp
    if taken is not None:
        message.start = JointState(name=list(names), position=taken.start.tolist())
        message.points = [
            JointTrajectoryPoint(positions=row, time_from_start=duration(at))
            for row, at in zip(taken.points.tolist(), taken.times.tolist(), strict=True)
        ]
    return message


def bus_report(
    config: ServoConfig, bus: SerialServoBus | None, cycle: Cycle | None, facts: dict[str, object]
) -> Report:
    """Counters of the bus and state of every servo, for diagnostics."""
    if bus is not None:
        facts |= {name: getattr(bus.counters, name) for name in bus.counters.__slots__}
    for name, servo_id in config.ids.items():
        state = cycle.states.get(servo_id) if cycle else None
        if state is not None:
            facts[f"{name} temperature [C]"] = state.temperature_c
            facts[f"{name} load [share]"] = round(state.load, 3)
            facts[f"{name} voltage [V]"] = round(state.voltage_v, 1)
    if cycle is not None and cycle.trouble:
        return Report(ERROR, cycle.trouble, facts)
    return Report(OK, "every servo answers", facts)
