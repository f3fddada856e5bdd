"""`kinematics` among machines whose clocks differ from its own."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest
from places import DEMO_ARM as ARM

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from nodes_bench import PATIENT, Bench, bench
from own_graph import own_graph
from played_driver import Driver, is_away
from std_msgs.msg import String
from target_requests import request

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import DriverLink
from longarm_comp.nodes.clock import sleepless_s
from longarm_comp.nodes.targets import TargetInlet
from longarm_interfaces.msg import DriverState

BEHIND = """
import time
true = time.time_ns
time.time_ns = lambda: true() - 3600 * 1_000_000_000
from longarm_comp.nodes.kinematics import main
main()
"""
"""All others are an hour ahead of this `kinematics`."""


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with own_graph(tmp_path_factory.mktemp("clocks")), bench() as made:
        options = {"arm": ARM, "method": "deflection", "compiled": "false", "acknowledged": "true"}
        words = [f"{name}:={value}" for name, value in {**options, **PATIENT}.items()]
        params = [word for each in words for word in ("-p", each)]
        made.python(["-c", BEHIND, "--ros-args", *params])
        yield made


def test_a_clock_that_is_ahead_does_not_hide_that_a_target_waited(stage: Bench, arm: Arm) -> None:
    driver, client = Driver(stage, arm), graph.COMPENSATE.client(stage.node)
    driver.instances = ("a",)
    ask = request(declared_model(arm).pose(arm.mid), arm, execute=True)
    stage.spin(lambda: stage.call(client, ask).success)
    driver.got.clear()
    waits = list[Any]()
    is_away(stage, stage.processes[0], 2.0, lambda: waits.append(client.call_async(ask)))
    stage.spin(lambda: waits[0].done())
    assert "this node was away" in waits[0].result().message and not driver.got
    stage.spin(lambda: stage.call(client, ask).success)


def test_a_clock_that_is_behind_does_not_make_a_stop_or_a_withdrawal_older(arm: Arm) -> None:
    heard: dict[graph.Topic, Any] = {}
    hear = SimpleNamespace(hear=lambda topic, callback, depth=0: heard.update({topic: callback}))
    tally = SimpleNamespace(tally=SimpleNamespace(count_dropped=None))
    state = SimpleNamespace(arm=arm, p={"acknowledged": True}, worker=hear, node=tally)
    link, inlet = DriverLink(cast(Any, state)), TargetInlet.__new__(TargetInlet)
    asked = sleepless_s()
    for stopped in (DriverState.ESTOP, DriverState.READY):
        heard[graph.DRIVER_STATE](DriverState(state=stopped, instance="a"), asked - 3600.0)
    inlet._on_withdrawn(String(), asked - 3600.0)
    assert "the arm was stopped after this was asked" in link.overtaken(asked)
    assert not link.overtaken(sleepless_s()) and asked <= inlet._withdrawn_s <= sleepless_s()
