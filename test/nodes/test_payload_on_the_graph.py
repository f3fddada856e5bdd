"""A payload that is told wrong, on the graph: the servos' loads say it, and correct the command."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nodes_bench import Bench, facts_of, last_status
from simulated_graph import simulated_graph
from std_msgs.msg import Float64
from target_requests import pose

from longarm_comp.core.errors import JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.nodes import interfaces as graph
from longarm_interfaces.msg import Compensation
from longarm_interfaces.srv import Compensate

CARRIED_KG, TOLD_KG = 0.9, 0.25


@pytest.fixture
def arm_at_work(ros_domain: int, demo_arm_path: Path) -> Iterator[ArmClient]:
    felt = {"move_time_s": 0.2, "payload.by_load": True, "context_max_age_s": 5.0}
    plant = {"payload_kg": CARRIED_KG, "context_rate_hz": 0.0, "frame_rate_hz": 10.0}
    with simulated_graph(demo_arm_path, felt, simulated_arm=plant) as client:
        client.ready(120.0)
        yield client


def test_a_payload_that_is_told_wrong_is_felt_and_then_used(arm_at_work: ArmClient) -> None:
    """Said while somebody tells it; once nobody does, commands are for what is felt."""
    client = arm_at_work
    said: list[DiagnosticArray] = []
    done: list[Compensation] = []
    told = graph.PAYLOAD.publisher(client.node)
    timer = client.node.create_timer(0.5, lambda: told.publish(Float64(data=TOLD_KG)))
    graph.DIAGNOSTICS.subscription(client.node, said.append)
    graph.COMPENSATION.subscription(client.node, done.append)

    def payload() -> DiagnosticStatus | None:
        return last_status(said, "kinematics: payload")

    rng, arm = np.random.default_rng(3), client.arm
    for k in range(15):
        q = arm.lower + rng.uniform(0.2, 0.8, arm.n) * (arm.upper - arm.lower)
        start = client.joints
        client.send(q[None], 0.2)
        client.arrive(q[None], Pace(dwell_s=0.2, tolerance=2e-3), start)
        client.until(
            lambda n=k + 1: int(facts_of(payload()).get("rests", 0)) >= n, 300.0, "weighed"
        )
        found = payload()
        if found.level == DiagnosticStatus.WARN:
            break
    assert found.level == DiagnosticStatus.WARN, found.message
    assert f"{TOLD_KG:g} kg is told" in found.message
    kg, sigma = (float(facts_of(found)[name]) for name in ("kg", "sigma [kg]"))
    assert abs(kg - CARRIED_KG) < 4.0 * sigma < 0.6
    client.node.destroy_timer(timer)

    def asked() -> bool:
        compensate.call_async(request)
        client.spin(1.0)
        return bool(done) and abs(done[-1].payload_kg - CARRIED_KG) < 4.0 * sigma

    compensate = graph.COMPENSATE.client(client.node)
    target = pose(declared_model(arm).tip(arm.mid))
    request = Compensate.Request(target=target, position_only=True)
    client.until(compensate.service_is_ready, 300.0, "compensate")
    client.until(asked, 300.0, "what is felt")
    assert "the payload is known to" in done[-1].message


def test_the_simulated_arm_takes_another_mass_while_it_runs(
    stage: Bench, demo_arm_path: Path, tmp_path: Path
) -> None:
    servos = demo_arm_path.parent / "servo_driver.yaml"
    given = {"arm": demo_arm_path, "servos": servos, "port": tmp_path / "bus"}
    stage.start("simulated_arm", {**given, "payload_kg": 0.3})
    told = stage.collect(graph.PAYLOAD)
    stage.spin(lambda: told and told[-1].data == 0.3)
    with GraphClient() as client:
        client.set_parameter("simulated_arm", "payload_kg", 0.5)
        with pytest.raises(JobError):
            client.set_parameter("simulated_arm", "payload_kg", -1.0)
    stage.spin(lambda: told[-1].data == 0.5)
