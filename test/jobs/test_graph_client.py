"""A client of a running graph whose servers come and go."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

import rclpy
from own_graph import own_graph
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.result import Method
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.jobs.graph_client import GraphClient, Interrupted
from longarm_comp.jobs.targets import TargetRunner
from longarm_comp.nodes import interfaces as graph
from longarm_interfaces.srv import Compensate


class Servers:
    """Nodes that offer the service `ask`; those in the executor answer."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.nodes: list[Node] = []

    def offer(self, name: str) -> Node:
        """A server that is found and does not answer, as one that was killed a moment ago."""
        self.nodes.append(Node(name, context=self.context))
        self.nodes[-1].create_service(Trigger, "ask", self._answer)
        return self.nodes[-1]

    def _answer(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        return response

    def close(self) -> None:
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def servers(tmp_path: Path) -> Iterator[Servers]:
    with own_graph(tmp_path):
        made = Servers()
        try:
            yield made
        finally:
            made.close()


def test_a_request_is_sent_again_to_a_server_that_comes_after_it(servers: Servers) -> None:
    servers.offer("dead")
    with GraphClient(name="asker") as client:
        service = client.node.create_client(Trigger, "ask")
        asked: list[Any] = []

        def sent(request: Any) -> Any:
            asked.append(request)
            if len(asked) == 2:
                servers.executor.add_node(servers.offer("alive"))
                threading.Thread(target=servers.executor.spin, daemon=True).start()
            return own(request)

        own, service.call_async = service.call_async, sent
        assert client.call(service, Trigger.Request(), 60.0, again=True).success
    assert len(asked) >= 2


def test_an_interrupted_target_is_withdrawn_and_so_is_what_was_sent_for_it(
    servers: Servers, arm: Arm
) -> None:
    stop, node, heard = threading.Event(), Node("kinematics", context=servers.context), list[str]()
    servers.nodes.append(node)
    withdrawn = Future(executor=servers.executor)

    async def answer(request: Any, response: Compensate.Response) -> Compensate.Response:
        """It was sent to the driver just before the withdrawal came."""
        assert request.execute
        stop.set()
        await withdrawn
        response.success, response.id = True, "sent"
        return response

    def hear(message: Any) -> None:
        heard.append(message.data)
        withdrawn.set_result(None)

    graph.compensate_by("both").server(node, answer, ReentrantCallbackGroup())
    graph.WITHDRAWN.subscription(node, hear)
    servers.executor.add_node(node)
    threading.Thread(target=servers.executor.spin, daemon=True).start()
    with ArmClient(arm, stop=stop) as client:
        runner = TargetRunner(client, Pace())
        client.until(client._withdrawn.get_subscription_count, 60.0, "nobody hears")
        with pytest.raises(Interrupted):
            runner.ask(np.zeros(3), Method.BOTH, execute=True)
        assert client.stop is stop
        client.stop = threading.Event()
        client.until(lambda: len(heard) == 2, 60.0, "no withdrawal")
    assert heard == ["", "sent"]
