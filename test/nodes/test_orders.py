"""Which trajectories `servo_driver` follows, as a process on an emulated bus."""

import signal
import time
from functools import partial

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from builtin_interfaces.msg import Time
from driver_rig import Rig
from lifecycle_msgs.msg import Transition
from rclpy.duration import Duration as Lapse
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.orders import order_id
from longarm_interfaces.msg import DriverState, Motion


def test_bad_trajectories_move_nothing_and_are_counted(rig: Rig) -> None:
    rig.stage.spin(lambda: rig.refused() >= 0)  # it has told how many
    before, already = rig.rests(), rig.refused()
    bad = ({"elbow": 0.1}, {"shoulder": 2.0}, {"shoulder": float("nan")}, {"boom": -0.01})
    for goal in bad:
        rig.send("bad", **goal)
    empty = JointTrajectory(joint_names=["boom"], points=[JointTrajectoryPoint()])
    empty.header.stamp = rig.stamps.next()
    rig.trajectories.publish(empty)

    rig.stage.spin(lambda: rig.refused() == already + len(bad) + 1)
    rig.becomes("bad", *[Motion.REFUSED] * len(bad))
    assert "elbow" in rig.told_of("bad")[0].message
    assert rig.joints() == pytest.approx(before, abs=1e-5)
    rig.goes(boom=0.02)


def test_orders_that_are_old_withdrawn_or_unstamped_move_nothing(rig: Rig) -> None:
    rig.goes(shoulder=0.2)
    before = rig.joints()
    now = rig.stage.node.get_clock().now()
    for name, stamp, words in (
        ("old", now - Lapse(seconds=3600), "3600."),
        ("future", now + Lapse(seconds=3600), "in the future"),
        ("unstamped", None, "header.stamp: 0"),
    ):
        rig.send(name, Time() if stamp is None else stamp.to_msg(), shoulder=0.6)
        assert words in rig.becomes(name, Motion.REFUSED).message
    withdrawals = graph.WITHDRAWN.publisher(rig.stage.node)
    rig.stage.connected(withdrawals)
    soon = rig.stamps.next()
    name = rig.send("asked", soon, 20, shoulder=0.9)
    rig.stage.spin(lambda: rig.events(name) == [Motion.ACCEPTED])
    withdrawals.publish(String(data="of somebody else"))
    withdrawals.publish(String(data=name))  # it is on its way
    rig.becomes(name, Motion.ACCEPTED, Motion.REPLACED)
    rig.becomes(f"{name} withdrawn", Motion.ACCEPTED, Motion.REACHED)
    assert rig.send("late", soon, 20, shoulder=0.9) == name
    told = rig.becomes(name, Motion.ACCEPTED, Motion.REPLACED, Motion.REFUSED)
    assert "withdrawn" in told.message
    assert rig.joints() == pytest.approx(before, abs=0.1)
    rig.goes(shoulder=0.0)


def test_beside_another_driver_it_moves_nothing_but_still_stops(rig: Rig) -> None:
    rig.goes(shoulder=0.2)
    states = graph.DRIVER_STATE.publisher(rig.stage.node)
    rig.stage.connected(states)
    other = DriverState(instance="another", state=DriverState.READY)
    beat = rig.stage.node.create_timer(0.2, lambda: states.publish(other))
    rig.stage.spin(
        lambda: (
            any("two drivers" in motion.message for motion in rig.motions)
            or not rig.send(shoulder=0.2)
        )
    )
    before = rig.rests()
    rig.send("far", shoulder=0.6)
    assert "two drivers" in rig.becomes("far", Motion.REFUSED).message
    halt = JointTrajectory(joint_names=rig.states[-1].name)
    halt.header.stamp = rig.stamps.next()
    rig.trajectories.publish(halt)
    rig.becomes(order_id(halt), Motion.ACCEPTED, Motion.REACHED)
    assert rig.joints() == pytest.approx(before, abs=1e-3)
    other.state = DriverState.UNCONFIGURED  # it has ended, or follows nothing yet
    rig.stage.spin(
        lambda: Motion.ACCEPTED in rig.events("again") or not rig.send("again", shoulder=0.2)
    )
    other.state = DriverState.READY
    rig.stage.spin(lambda: "two drivers" in rig.motions[-1].message or not rig.send(shoulder=0.2))
    rig.stage.node.destroy_timer(beat)  # killed: it says nothing any more
    rig.stage.node.destroy_publisher(states)
    rig.stage.spin(
        lambda: Motion.ACCEPTED in rig.events("last") or not rig.send("last", shoulder=0.4)
    )
    rig.arrives(shoulder=0.4)


def test_a_driver_that_was_away_moves_nothing_that_came_meanwhile(rig: Rig) -> None:
    """Stopped and continued, at rest and on the way."""
    rig.goes(shoulder=0.0)
    away = 3.0  # more than order_max_age_s

    def stopped(*sent: tuple[str, Time | None]) -> None:
        rig.process.send_signal(signal.SIGSTOP)
        for name, stamp in sent:
            rig.send(name, stamp, shoulder=0.8)
        end = time.monotonic() + away
        rig.stage.spin(lambda: time.monotonic() > end)
        rig.process.send_signal(signal.SIGCONT)

    stopped(("meanwhile", None))
    assert "s old" in rig.becomes("meanwhile", Motion.REFUSED).message
    assert rig.joints()["shoulder"] == pytest.approx(0.0, abs=1e-3)
    rig.is_idle()
    way = rig.send("way", None, 20, shoulder=0.9)
    rig.stage.spin(lambda: rig.joints()["shoulder"] > 0.05)
    stopped()
    told = rig.becomes(way, Motion.ACCEPTED, Motion.BROKEN_OFF)
    assert "was away" in told.message
    assert rig.joints()["shoulder"] < 0.3
    rig.is_in(DriverState.READY)
    rig.goes(shoulder=0.0)


def test_an_order_that_waited_on_the_way_through_a_stop_moves_nothing(rig: Rig) -> None:
    rig.ends()
    rig.start(order_max_age_s=60.0)
    rig.in_order().is_in(DriverState.READY)
    rig.goes(shoulder=0.0)

    def stopped(service: graph.Service) -> None:
        assert rig.call(service, SetBool.Request(data=True)).success
        assert rig.call(graph.RESET, Trigger.Request()).success

    def inactive(transition: str) -> None:
        assert rig.change(getattr(Transition, f"TRANSITION_{transition}"))

    def frozen() -> None:
        """For less than orders may be old, but what was said meanwhile may be lost."""
        rig.process.send_signal(signal.SIGSTOP)
        by = time.monotonic() + 1.5
        rig.stage.spin(lambda: time.monotonic() > by)
        rig.process.send_signal(signal.SIGCONT)

    for stops in (
        [frozen], [partial(stopped, graph.HOLD)], [partial(stopped, graph.ESTOP)],
        [partial(inactive, "DEACTIVATE"), partial(inactive, "ACTIVATE")],
    ):  # fmt: skip
        before = rig.stamps.next()
        for stop in stops:
            stop()
        rig.is_in(DriverState.READY)
        told = rig.becomes(rig.send(stamp=before, shoulder=0.5), Motion.REFUSED)
        assert "before the arm was stopped" in told.message
    assert rig.rests()["shoulder"] == pytest.approx(0.0, abs=1e-3)
    rig.goes(shoulder=0.1)
