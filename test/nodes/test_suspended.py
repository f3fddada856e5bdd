"""A machine that is suspended: its monotonic clock stands still meanwhile."""

import signal
import time

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from builtin_interfaces.msg import Time
from driver_rig import Rig
from nodes_bench import Bench
from rclpy.duration import Duration as Lapse

from longarm_comp.nodes.clock import sent_s, sleepless_s
from longarm_comp.nodes.orders import Freshness
from longarm_interfaces.msg import DriverState, Motion

NIGHT_S = 30_000.0
DRIVER = f"""
import signal, time
slept, gettime = [0.0], time.clock_gettime
time.clock_gettime = lambda c: gettime(c) + (slept[0] if c == time.CLOCK_BOOTTIME else 0.0)
signal.signal(signal.SIGUSR1, lambda *_: slept.__setitem__(0, {NIGHT_S}))
from longarm_comp.nodes.servo_driver import main
main()
"""


def test_a_motion_is_not_continued_after_a_night(rig: Rig) -> None:
    rig.ends()
    del rig.states[:], rig.said[:], rig.diagnostics[:]
    words = ["-c", DRIVER, "--ros-args", "--params-file", str(rig.file)]
    rig.process = rig.stage.python(words)
    rig.is_in(DriverState.READY)
    rig.is_idle()
    rig.goes(shoulder=0.0)
    way = rig.send("way", None, 20, shoulder=0.9)
    rig.stage.spin(lambda: rig.joints()["shoulder"] > 0.05)
    rig.process.send_signal(signal.SIGUSR1)
    told = rig.becomes(way, Motion.ACCEPTED, Motion.BROKEN_OFF)
    assert "was away" in told.message
    assert rig.joints()["shoulder"] < 0.85
    rig.ends()
    rig.start()


def test_what_came_before_a_night_is_too_old_and_what_comes_a_minute_after_is_not(
    stage: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept, gettime = [0.0], time.clock_gettime
    monkeypatch.setattr(time, "clock_gettime", lambda clock: gettime(clock) + slept[0])
    fresh = Freshness(stage.node, 45.0)
    assert not fresh.too_old(Time())
    slept[0] = NIGHT_S
    assert fresh.away_s >= NIGHT_S and "away for so long" in fresh.too_old(Time())
    fresh._note_turn()
    assert fresh.away_s >= NIGHT_S

    def passes(seconds: float) -> None:
        for _ in range(round(2.0 * seconds)):
            slept[0] += 0.5
            fresh._note_turn()

    passes(40.0)
    assert "away for so long" in fresh.too_old(Time())
    passes(30.0)
    assert not fresh.too_old(Time())


def test_an_order_from_before_an_absence_in_which_a_stop_may_be_missed_moves_nothing(
    stage: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept, gettime = [0.0], time.clock_gettime
    monkeypatch.setattr(time, "clock_gettime", lambda clock: gettime(clock) + slept[0])

    def stamp() -> Time:
        return stage.node.get_clock().now().to_msg()

    fresh, before = Freshness(stage.node, 45.0), stamp()
    slept[0] += 0.9
    fresh._note_turn()
    assert not fresh.too_old(before)
    slept[0] += 1.1
    assert "this node was away" in fresh.too_old(before)
    fresh._note_turn()
    assert "this node was away" in fresh.too_old(before)
    assert not fresh.too_old(stamp())
    ahead = (stage.node.get_clock().now() + Lapse(seconds=20)).to_msg()
    assert "this node was away" in fresh.too_old(ahead)  # nobody knows when that was sent
    for _ in range(3):
        slept[0] += 0.9
        fresh._note_turn()
    assert not fresh.too_old(ahead)


def test_a_message_that_waited_through_a_night_was_sent_before_it(
    stage: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept, gettime = [0.0], time.clock_gettime
    monkeypatch.setattr(
        time,
        "clock_gettime",
        lambda clock: gettime(clock) + (slept[0] if clock == time.CLOCK_BOOTTIME else 0.0),
    )
    fresh, now = Freshness(stage.node, 45.0), stage.node.get_clock().now()
    waits = sent_s(time.time_ns())
    slept[0] = NIGHT_S
    later = sent_s(time.time_ns())
    assert waits is not None and later is not None and later - waits >= NIGHT_S
    assert sent_s(0) is None and sent_s(time.time_ns() + 60_000_000_000) is None
    slept[0] = 0.0
    hour = (now - Lapse(seconds=3600)).to_msg()
    for stamp, told_s, earlier_s in (
        (Time(), None, 0.0), (hour, None, 3600.0), (hour, sleepless_s(), 3600.0),
        (Time(), sleepless_s() - 7.0, 7.0), (hour, sleepless_s() - 7200.0, 7200.0),
    ):  # fmt: skip
        assert sleepless_s() - fresh.sent_s(stamp, told_s) == pytest.approx(earlier_s, abs=5.0)
