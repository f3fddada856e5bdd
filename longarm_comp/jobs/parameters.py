"""Parameters of the nodes of a running graph: read, set."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter as NamedParameter
from rclpy.parameter import parameter_value_to_python

from longarm_comp.core.errors import JobError
from longarm_comp.jobs.client import GraphClient


def read_parameters(
    client: GraphClient, node: str, *names: str, within_s: float = 60.0
) -> list[Any]:
    """Values of a node's parameters, in the order of the names; None where it has none."""
    service = client.node.create_client(GetParameters, f"{node}/get_parameters")
    try:
        answer = client.call(
            service, GetParameters.Request(names=list(names)), within_s, again=True
        )
    finally:
        client.node.destroy_client(service)
    return [parameter_value_to_python(value) for value in answer.values]


def set_parameter(client: GraphClient, node: str, name: str, value: bool | float | str) -> None:
    """Set a parameter of a node."""
    told: Parameter = NamedParameter(name, value=value).to_parameter_msg()
    service = client.node.create_client(SetParameters, f"{node}/set_parameters")
    try:
        answer = client.call(service, SetParameters.Request(parameters=[told]), again=True)
    finally:
        client.node.destroy_client(service)
    if not answer.results[0].successful:
        raise JobError(answer.results[0].reason, node=node, parameter=name, value=value)
