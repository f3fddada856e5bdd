"""Ends of stops: none ends a stop that came after it was asked, nor what it does not name."""

import errno
import os
import tempfile
import threading
import time
from concurrent import futures
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from builtin_interfaces.msg import Time
from rclpy.duration import Duration as Lapse
from std_srvs.srv import SetBool, Trigger
from stops_bench import MAX_AGE_S, StoppedArm

from longarm_comp.devices import stop_latch
from longarm_comp.devices.follower_report import FollowerState
from longarm_comp.devices.servo_watch import JointFault, ServoTrouble
from longarm_comp.devices.stop_latch import Stop, StopLatch
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes import stops
from longarm_comp.nodes.clock import sleepless_s
from longarm_comp.nodes.worker import Asked
from longarm_interfaces.msg import DriverState

ENDS = {"reset": (graph.RESET, None), "estop": (graph.ESTOP, False), "hold": (graph.HOLD, False)}


def serve(driver: StoppedArm, service: graph.Service, data: bool | None, sent_ns: int) -> Any:
    """Its answer to a request that was sent then, by its sender's clock."""
    got: list[Any] = []
    request = Trigger.Request() if data is None else SetBool.Request(data=data)
    driver.stops.serve([Asked(service, request, got.append, sent_ns)])
    driver.stage.spin(lambda: got)
    return got[0]


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("stop", [graph.ESTOP, graph.HOLD])
def test_an_end_that_was_asked_before_a_stop_does_not_end_it(
    driver: StoppedArm, end: str, stop: graph.Service
) -> None:
    """Both wait: the executor alone would serve them in the order in which they were made."""
    assert driver.ask(graph.HOLD, True).success
    before = [driver.send(*ENDS[end]), driver.send(*ENDS[end])]
    stopped = driver.send(stop, True)
    refused = driver.answers(*before, stopped)[:-1]
    assert not any(answer.success for answer in refused)
    assert all("a stop came after this was asked" in answer.message for answer in refused)
    assert stopped.result().success and driver.stops.standing
    assert driver.on == {stop is graph.HOLD}
    assert driver.ask(graph.RESET).success and not driver.stops.standing
    assert driver.on == {True}


def test_an_end_that_was_asked_while_the_stop_was_carried_out_does_not_end_it(
    driver: StoppedArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[int] = []
    monkeypatch.setattr(driver.stops, "let_go", lambda: sent.append(time.time_ns()))
    serve(driver, graph.ESTOP, True, 0)
    assert "a stop came after" in serve(driver, *ENDS["reset"], sent[0]).message


def test_an_end_that_is_served_long_after_it_was_sent_ends_nothing(driver: StoppedArm) -> None:
    second = 1_000_000_000
    assert driver.ask(graph.ESTOP, True).success
    driver.stops._stopped -= 3600.0
    for name, end in ENDS.items():
        old = serve(driver, *end, time.time_ns() - int((MAX_AGE_S + 1.0) * second))
        assert not old.success and "ago, allowed 5 s" in old.message, name
    assert driver.stops.estop and driver.on == {False}
    assert serve(driver, *ENDS["reset"], time.time_ns() - int((MAX_AGE_S - 2.0) * second)).success
    assert driver.on == {True}


@pytest.mark.parametrize("ahead_s", [None, 3600])
def test_an_end_whose_time_is_not_told_may_have_waited_while_the_driver_was_away(
    driver: StoppedArm, ahead_s: int | None
) -> None:
    """Nor does a clock that is ahead tell it."""
    sent_ns = 0 if ahead_s is None else time.time_ns() + 1_000_000_000 * ahead_s
    assert driver.ask(graph.ESTOP, True).success
    assert "a stop came after" in serve(driver, *ENDS["reset"], sent_ns).message
    driver.stops._stopped -= 100.0
    driver.fresh._away_s, driver.fresh._back = MAX_AGE_S + 1.0, sleepless_s()
    assert "ago, allowed" in serve(driver, *ENDS["reset"], sent_ns).message
    driver.fresh._away_s = 0.0
    assert serve(driver, *ENDS["reset"], sent_ns).success
    assert driver.on == {True}


@pytest.mark.parametrize("end", ENDS)
def test_a_stop_stands_for_a_second_whatever_the_clock_of_who_ends_it(
    driver: StoppedArm, end: str
) -> None:
    """What was sent before it may be on its way for so long, or come from a clock that is ahead."""
    second = 1_000_000_000
    for stop in (graph.ESTOP, graph.HOLD):
        assert driver.ask(stop, True).success
    for since_s, asked_s in ((0.5, 0.0), (0.5, -3600.0), (3.0, 2.5)):
        driver.stops._stopped = sleepless_s() - since_s
        refused = serve(driver, *ENDS[end], time.time_ns() - int(asked_s * second))
        assert "a stop came after this was asked, or less than 1 s before" in refused.message
    for since_s, asked_s in ((1.5, 0.0), (1.5, -3600.0), (4.0, 2.5)):
        driver.stops._stopped = sleepless_s() - since_s
        assert serve(driver, *ENDS[end], time.time_ns() - int(asked_s * second)).success


@pytest.mark.parametrize("end", ["estop", "hold"])
def test_an_end_of_one_stop_leaves_a_fault_and_the_other_stop_in_force(
    driver: StoppedArm, end: str
) -> None:
    driver.in_fault()
    assert driver.arm is not None
    assert driver.ask(*ENDS[end]).success
    assert driver.arm.follower.state is FollowerState.FAULT
    assert driver.ask(graph.HOLD, True).success
    assert driver.ask(graph.ESTOP, False).success
    assert driver.arm.follower.state is FollowerState.FAULT and "held" in driver.stops.standing
    assert driver.ask(graph.RESET).success and not driver.stops.standing
    assert driver.arm.follower.state is FollowerState.IDLE and driver.on == {True}


@pytest.mark.parametrize("end", ENDS)
def test_an_end_of_nothing_leaves_a_motion_as_it_is(driver: StoppedArm, end: str) -> None:
    driver.moves()
    assert driver.ask(*ENDS[end]).message == "ready"
    cycle = driver.cycles()[-1]
    assert cycle.step.state is FollowerState.TRACKING and cycle.step.goals


@pytest.mark.parametrize("end", ENDS)
def test_an_end_of_nothing_switches_no_torque_on(driver: StoppedArm, end: str) -> None:
    """It is off though the driver is active: a servo was silent when it was to go on."""
    assert driver.arm is not None
    driver.arm.power(False)
    assert driver.ask(*ENDS[end]).success
    assert driver.on == {False}


@pytest.mark.parametrize("was_on", [True, False])
def test_a_hold_that_outlasts_an_emergency_stop_has_the_torque_that_it_had(
    driver: StoppedArm, was_on: bool
) -> None:
    assert driver.ask(graph.HOLD, True).success
    if not was_on:  # the next driver finds the hold
        assert driver.arm is not None
        driver.arm.close()
        driver.configure()
    for _ in range(2):
        assert driver.ask(graph.ESTOP, True).success and driver.on == {False}
    assert driver.ask(graph.ESTOP, False).success and driver.on == {was_on}
    assert driver.stops.standing
    assert driver.ask(graph.HOLD, False).success and driver.on == {True}


def test_the_end_of_a_hold_switches_the_torque_neither_under_another_stop_nor_where_it_is_on(
    driver: StoppedArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    switched: list[bool] = []
    for stop in (graph.HOLD, graph.ESTOP):
        assert driver.ask(graph.HOLD, True).success and driver.ask(stop, True).success
        with monkeypatch.context() as patch:
            patch.setattr(driver.arm, "power", switched.append)
            assert driver.ask(graph.HOLD, False).success
    assert not switched and driver.stops.estop and "held" not in driver.stops.standing


def test_after_an_emergency_stop_of_an_arm_whose_torque_was_off_it_goes_on(
    driver: StoppedArm,
) -> None:
    """The next driver finds the stop; nothing else stops the arm."""
    assert driver.arm is not None
    assert driver.ask(graph.ESTOP, True).success
    driver.arm.close()
    driver.stops._was_on = False
    driver.configure()
    assert driver.on == {False}
    assert driver.ask(graph.ESTOP, False).success and driver.on == {True}


def test_ends_while_no_arm_is_configured_answer_with_the_state(driver: StoppedArm) -> None:
    assert driver.arm is not None
    driver.arm.close()
    driver.arm, driver.state = None, (DriverState.UNCONFIGURED, "not configured")
    for stop in (None, graph.ESTOP, graph.HOLD):
        assert stop is None or driver.ask(stop, True)
        for end in ENDS.values():
            answer = driver.ask(*end)
            assert answer.success and answer.message == "not configured"
        assert not driver.stops.standing and driver.on == {False}


@pytest.mark.parametrize("stop", [graph.ESTOP, graph.HOLD])
def test_an_order_from_before_a_stop_or_its_end_is_too_old_after_it(
    driver: StoppedArm, stop: graph.Service
) -> None:
    """It waited, in its sender or on the way, no longer than an order may."""
    now, fresh = driver.stage.node.get_clock().now, driver.fresh
    fresh.max_age_s = 3600.0
    before = now().to_msg()
    assert not fresh.too_old(before)
    assert driver.ask(stop, True).success
    under = now().to_msg()
    assert driver.ask(graph.RESET).success and driver.on == {True}
    for old in (before, under):
        assert "sent before the arm was stopped" in fresh.too_old(old)
    assert not fresh.too_old(now().to_msg())
    assert [standing for standing, _ in driver.told[-2:]] == [True, False]
    fresh._turned -= 60.0  # the node was away: nobody knows when an order without a stamp came
    assert "sent before the arm was stopped" in fresh.too_old(Time())
    driver.ask(graph.RESET)  # it ends nothing
    fresh._note_turn()
    assert not fresh.too_old(now().to_msg())


@pytest.mark.parametrize("ahead_s", [-1.0, 1.0])
def test_a_clock_that_is_set_makes_no_old_order_new_nor_a_new_one_old(
    driver: StoppedArm, monkeypatch: pytest.MonkeyPatch, ahead_s: float
) -> None:
    true, fresh = driver.stage.node.get_clock(), driver.fresh
    before = true.now().to_msg()
    assert driver.ask(graph.ESTOP, True).success and driver.ask(graph.RESET).success
    ahead = Lapse(seconds=ahead_s)
    is_set = SimpleNamespace(now=lambda: true.now() + ahead, ros_time_is_active=False)
    monkeypatch.setattr(fresh, "_clock", is_set)
    assert not fresh.too_old(is_set.now().to_msg())
    assert "sent before" in fresh.too_old(before)


def test_every_request_is_answered_whatever_another_raises(
    driver: StoppedArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(response: Any) -> None:
        raise RuntimeError("its client is gone")

    held: list[Any] = []
    data = SetBool.Request(data=True)
    waiting = [Asked(graph.ESTOP, data, lost, 0), Asked(graph.HOLD, data, held.append, 0)]
    monkeypatch.setattr(stops, "_MOMENT_S", 60.0)
    with pytest.raises(RuntimeError, match="is gone"):
        driver.stops.serve(waiting)
    assert held and driver.stops.estop and "held" in driver.stops.standing


@pytest.mark.parametrize(("stop", "file"), [(graph.ESTOP, "*.estop"), (graph.HOLD, "*.hold")])
def test_a_stop_is_kept_before_it_is_answered(
    driver: StoppedArm, tmp_path: Path, stop: graph.Service, file: str
) -> None:
    assert serve(driver, stop, True, 0).success
    assert list((tmp_path / "stops").glob(file))


def test_an_emergency_stop_is_kept_before_the_torque_goes_off(
    driver: StoppedArm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A driver that is killed in between leaves it to the next one."""
    monkeypatch.setattr(stops, "_MOMENT_S", 60.0)
    assert driver.arm is not None
    kept: list[Stop] = []

    def off() -> None:
        made = StopLatch(tmp_path / "stops", "/", "", driver.config.bus.port)
        kept.extend(made.standing)
        own()

    own = driver.arm.estop
    monkeypatch.setattr(driver.arm, "estop", off)
    assert driver.ask(graph.ESTOP, True).success and driver.on == {False}
    assert kept == [Stop.ESTOP]


@pytest.mark.parametrize("hangs", [(os, "fsync"), (Path, "touch")])
def test_a_disk_that_hangs_delays_no_stop(
    driver: StoppedArm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hangs: tuple[Any, str]
) -> None:
    monkeypatch.setattr(stop_latch, "_DISK_S", 0.0)
    answers = threading.Event()
    with monkeypatch.context() as patch:
        patch.setattr(*hangs, lambda *_, **__: answers.wait(60.0))
        driver.in_fault()
        driver.stops.keep_fault(JointFault(ServoTrouble.STALLED, "a", "against something"))
        assert driver.on == {True}
        served = serve(driver, graph.ESTOP, True, 0)
        assert driver.on == {False} and "does not answer" in driver.stops.standing
        driver.stops._stopped -= 2.0
        assert "the stop stays" in serve(driver, graph.RESET, None, time.time_ns()).message
        assert driver.stops.estop and driver.on == {False} and not answers.is_set()
        answers.set()
    assert served.success
    driver.stage.spin(lambda: not driver.stops.unkept)
    latch = StopLatch(tmp_path / "stops", "/", "", driver.config.bus.port)
    assert set(latch.standing) == {Stop.ESTOP, Stop.FAULT}


@pytest.mark.parametrize("stop", [graph.ESTOP, graph.HOLD])
def test_a_stop_is_answered_when_the_disk_has_kept_it_and_the_arm_is_driven_on_meanwhile(
    driver: StoppedArm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: graph.Service
) -> None:
    """Nobody ends a stop whose sender has no answer yet."""
    monkeypatch.setattr(stop_latch, "_DISK_S", 600.0)
    driver.moves()
    got: list[Any] = []
    waited: list[float] = []
    goes_on, wait = threading.Event(), futures.wait

    def waits(for_them: Any, within_s: float) -> None:
        waited.append(within_s)
        wait(for_them, min(within_s, stops._MOMENT_S))

    with monkeypatch.context() as patch, ExitStack() as end:
        end.callback(goes_on.set)
        own = os.fsync
        patch.setattr(os, "fsync", lambda file: (goes_on.wait(600.0), own(file)))
        patch.setattr(futures, "wait", waits)
        driver.stops.serve([Asked(stop, SetBool.Request(data=True), got.append, 0)])
        assert driver.arm is not None
        driver.cycles(lambda: driver.arm.follower.state is not FollowerState.TRACKING)
        driver.stops.keep_fault(JointFault(ServoTrouble.STALLED, "a", "against something"))
        driver.stops.keep_doubt("a may have lost count")
        ended = serve(driver, graph.RESET, None, time.time_ns())
        assert "a stop came after this was asked" in ended.message
        assert not got and not driver.stops.unkept and driver.on == {stop is graph.HOLD}
        assert max(waited) <= stops._MOMENT_S
        goes_on.set()
        driver.stage.spin(lambda: got)
    assert got[0].success and list((tmp_path / "stops").glob(f"*.{stop.name[2:]}"))


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_is_full_or_read_only_prevents_no_stop(
    driver: StoppedArm, monkeypatch: pytest.MonkeyPatch, error: int
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError(error, os.strerror(error))

    with monkeypatch.context() as patch:
        for place, name in ((Path, "touch"), (os, "fsync"), (tempfile, "mkstemp")):
            patch.setattr(place, name, fails)
        assert driver.ask(graph.ESTOP, True).success
        assert driver.on == {False} and driver.stops.unkept
    driver.stage.spin(lambda: not driver.stops.unkept)


def test_ends_are_sent_once_and_stops_until_they_are_answered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A copy of an end would end a stop that came after it was asked for."""
    pytest.importorskip("viser")
    from longarm_comp.jobs import attend
    from longarm_comp.view import panel

    sent: dict[str, bool] = {}

    def asked(
        node: str, service: graph.Service, request: Any, within_s: float, *, again: bool
    ) -> Any:
        sent[f"{service.name} {getattr(request, 'data', '')}"] = again
        return SimpleNamespace(success=True, message="")

    made = attend.Attendant.__new__(attend.Attendant)
    made._client = SimpleNamespace(ask=asked, spin=lambda seconds: None)
    monkeypatch.setattr(made, "hear_stop", lambda: "own", raising=False)
    monkeypatch.setattr(
        made, "_hear_driver", lambda: SimpleNamespace(state=attend.STOPPED[0]), raising=False
    )
    made.hold(), made.stop(), made.reset(), made.take_back("own")
    assert sent == {"~/hold True": True, "~/estop True": True, "~/reset ": False,
                    "~/estop False": False}  # fmt: skip

    pressed: list[tuple[Any, bool]] = []

    class Noted:
        def __init__(self, client: Any, request: Any, *, again: bool) -> None:
            pressed.append((request, again))

        def answer(self) -> None: ...

    client = SimpleNamespace(service_is_ready=lambda: True)
    monkeypatch.setattr(panel, "Call", Noted)
    node = SimpleNamespace(create_client=lambda *_, **__: client)
    buttons = panel.Buttons(node)
    for button in (*panel.STOPS, *panel.RELEASES):
        buttons.press(button)
    buttons.step(time.monotonic())
    assert [again for _, again in pressed] == [True, True, False, False, False]
    assert all(getattr(request, "data", False) is again for request, again in pressed)
