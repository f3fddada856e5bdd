"""The generated messages: they match the contract and arrive over a real graph."""

import math

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
pytest.importorskip("longarm_interfaces.msg", reason="run make setup")

from geometry_msgs.msg import PoseStamped, Vector3
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from longarm_interfaces.msg import Compensation
from longarm_interfaces.srv import Compensate, PredictError

STATUSES = [
    "SUCCESS",
    "NO_PREDICTOR",
    "OUT_OF_DOMAIN",
    "UNREACHABLE",
    "BAD_TARGET",
    "BAD_FRAME",
    "STALE_CONTEXT",
    "NOT_READY",
    "NOT_CONVERGED",
    "CORRECTION_TOO_LARGE",
    "INTERNAL_ERROR",
]

SPEC = {
    Compensate.Request: {
        "target": "geometry_msgs/PoseStamped",
        "position_only": "boolean",
        "seed": "sensor_msgs/JointState",
        "execute": "boolean",
    },
    Compensate.Response: {
        "success": "boolean",
        "status": "uint8",
        "message": "string",
        "id": "string",
        "ideal": "sensor_msgs/JointState",
        "command": "sensor_msgs/JointState",
        "run_up": "sensor_msgs/JointState",
        "approach": "sequence<int8>",
        "predicted_error": "geometry_msgs/Vector3",
        "pseudo_target": "geometry_msgs/PoseStamped",
        "sigma": "double",
        "in_domain": "boolean",
        "passes": "uint32",
    },
    PredictError.Request: {
        "joints": "sensor_msgs/JointState",
        "approach": "sequence<int8>",
        "temperature_c": "double",
        "payload_kg": "double",
    },
    PredictError.Response: {
        "success": "boolean",
        "message": "string",
        "error": "geometry_msgs/Vector3",
        "sigma": "double",
        "in_domain": "boolean",
        "beside_deflection": "boolean",
        "jacobian": "sequence<double>",
        "reach": "sequence<double>",
    },
}


@pytest.mark.parametrize("kind", SPEC, ids=lambda kind: kind.__name__)
def test_services_carry_what_the_contract_lists(kind: type) -> None:
    assert kind.get_fields_and_field_types() == SPEC[kind]


@pytest.mark.parametrize("kind", [Compensation, Compensate.Response])
def test_status_constants_are_the_same_in_both_lists(kind: type) -> None:
    assert [getattr(kind, name) for name in STATUSES] == list(range(len(STATUSES)))


def test_compensation_tells_the_whole_story() -> None:
    story = Compensation(
        position_only=True,
        ideal=JointState(name=["joint_1"], position=[0.25]),
        predicted_error=Vector3(x=1e-3, y=-2e-3, z=-17e-3),
        sigma=math.nan,
        executed=JointState(name=["joint_1"], position=[0.26]),
        passes=3,
        status=Compensation.NO_PREDICTOR,
        message="no predictor answered",
        method="deflection",
        approach=-1,
        arm_hash="a" * 64,
    )
    story.header.frame_id = "base_link"
    story.pseudo_target.pose.position.z = 0.517
    heard = deserialize_message(serialize_message(story), Compensation)
    assert math.isnan(heard.sigma)
    heard.sigma = story.sigma = 0.0
    assert heard == story


def test_services_answer_over_the_graph(ros_domain: int) -> None:
    def answer(request: Compensate.Request, response: Compensate.Response) -> Compensate.Response:
        response.success = True
        response.status = Compensate.Response.OUT_OF_DOMAIN
        response.pseudo_target = request.target
        response.command = request.seed
        return response

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("echo", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        node.create_service(Compensate, "compensate", answer)
        client = node.create_client(Compensate, "compensate")
        assert client.wait_for_service(300.0)
        target = PoseStamped()
        target.pose.position.x = 0.4
        reply = client.call_async(
            Compensate.Request(target=target, seed=JointState(name=["a"], position=[1.5]))
        )
        executor.spin_until_future_complete(reply, 20.0)
        response = reply.result()
    finally:
        node.destroy_node()
        executor.shutdown()
        rclpy.shutdown(context=context)
    assert response.status == Compensate.Response.OUT_OF_DOMAIN
    assert response.pseudo_target.pose.position.x == 0.4
    assert response.command.position.tolist() == [1.5]
