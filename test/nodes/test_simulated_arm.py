"""`simulated_arm` while it runs: what is set together is taken together, or not at all."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from nodes_bench import Bench
from places import DEMO_ARM as ARM
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from simulated_graph import forked_graph

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import BringUp


def test_values_of_which_one_is_refused_change_nothing(stage: Bench) -> None:
    others = ("servo_driver", "stereo_bridge", "kinematics", "error_predictor")
    payloads = stage.collect(graph.PAYLOAD)
    with forked_graph(BringUp(arm=ARM, sim=True, without=others)):
        setter = stage.node.create_client(
            SetParametersAtomically, "simulated_arm/set_parameters_atomically"
        )

        def sets(**values: object) -> bool:
            asked = [
                Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
            ]
            request = SetParametersAtomically.Request(parameters=asked)
            return bool(stage.call(setter, request).result.successful)

        def carried() -> float:
            del payloads[:]
            stage.spin(lambda: len(payloads) > 1)
            return float(payloads[-1].data)

        stood = carried()
        assert not sets(payload_kg=1.5, covered="nose")
        assert not sets(payload_kg=5000.0)
        assert carried() == stood
        assert sets(payload_kg=1.5, covered="left")
        assert carried() == 1.5
