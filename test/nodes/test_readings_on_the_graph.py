"""The tip by readings, on the graph of an arm whose servos give way: said, watched and trimmed."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from cli_shell import Shell
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped
from nodes_bench import PATIENCE_S, answered
from rclpy.action import ActionClient
from simulated_graph import simulated_graph
from target_requests import pose

from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import ArmClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import RING_SAID
from longarm_interfaces.action import Reach
from longarm_interfaces.srv import Compensate

DROOP = "servo_droop=4.0 servo_deadband=0.7"
TIP_STANDS = "By the readings the tip is at"


def reached(client: ArmClient, reach: ActionClient, target: PoseStamped) -> Reach.Result:
    """The result of a goal, sent again while it was too old when it was taken up."""
    for _ in range(20):
        sent = reach.send_goal_async(Reach.Goal(target=target, position_only=True))
        client.until(sent.done, PATIENCE_S, "goal")
        done = sent.result().get_result_async()
        client.until(done.done, PATIENCE_S, "result")
        result = done.result().result
        if result.status != Compensate.Response.STALE_TARGET:
            assert result.success, result.message
            return result
    raise AssertionError(f"too old every time: {result.message}")


@pytest.fixture(
    params=[
        pytest.param(False, id="plain", marks=pytest.mark.long),
        pytest.param(True, id="trimmed"),
    ]
)
def arm_at_work(
    request: pytest.FixtureRequest, ros_domain: int, demo_arm_path: Path
) -> Iterator[tuple[ArmClient, bool]]:
    plant = {"hidden": DROOP, "seed": 3, "frame_rate_hz": 10.0}
    driver = {"trim": request.param, "follower.trim_pause_s": 0.5}
    with simulated_graph(
        demo_arm_path,
        {"move_time_s": 0.2},
        simulated_arm=plant,
        servo_driver=driver,
    ) as client:
        client.ready(PATIENCE_S)
        yield client, request.param


def test_the_tip_by_readings_sees_a_droop_that_no_model_holds(
    arm_at_work: tuple[ArmClient, bool],
    tmp_path: Path,
    demo_arm_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Reach says it with its doubt, status and verify too; trim leaves nothing of it."""
    client, trim = arm_at_work
    truth: list[np.ndarray] = []
    client.node.create_subscription(
        PointStamped,
        "simulated_arm/true_tip",
        lambda m: truth.append(np.array([m.point.x, m.point.y, m.point.z])),
        20,
    )
    arm = client.arm
    want = declared_model(arm).tip(arm.lower + 0.6 * (arm.upper - arm.lower))
    reach = ActionClient(client.node, Reach, graph.REACH.name)
    answered(reach, Reach, lambda until: client.until(until, PATIENCE_S, "reach"))
    for _ in range(2):  # the second starts from what the first one trimmed
        result = reached(client, reach, pose(want))
    assert "by the readings the tip is" in result.message and ", within " in result.message
    del truth[:], client.sightings[:]
    client.until(lambda: len(truth) > 2 and len(client.sightings) > 1, PATIENCE_S, "tips")
    off, by_readings = truth[-1] - want, client.sightings[-1][1]
    assert np.linalg.norm(by_readings - truth[-1]) < 3e-4
    if trim:
        assert np.linalg.norm(off) < 3e-4
    else:
        assert np.linalg.norm(off) > 2e-3
    rings: list[str] = []
    client.node.create_subscription(
        DiagnosticArray,
        "/diagnostics",
        lambda m: rings.extend(s.message for s in m.status if s.name.endswith(f": {RING_SAID}")),
        20,
    )
    client.until(lambda: rings and "the tip swings by" in rings[-1], PATIENCE_S, "the ring")
    assert "mm at most" in rings[-1] and "Hz; within 0.1 mm after" in rings[-1]
    shell = Shell(tmp_path, capsys)
    client.until(lambda: shell("status") == 0 and TIP_STANDS in shell.out, PATIENCE_S, shell.out)
    quick = ("--move", 0.2, "--sightings", 2, "--dwell", 0.3)
    verified = shell("verify", demo_arm_path, "-n", 2, "--by", "readings", *quick, "--json")
    assert shell.out, shell.err
    report = json.loads(shell.out)
    assert report["targets"] == 2
    with_it = report["rows"][-1]["mean_mm"]
    assert with_it < 0.5 if trim else with_it > 2.0
    assert verified == (0 if report["helps"] else 3)
