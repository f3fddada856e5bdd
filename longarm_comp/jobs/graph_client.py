"""A client of a running graph: waits, calls services, reads parameters and reports of nodes.

It uses one executor in the caller's thread. Every wait ends at once when ``stop`` is set.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.signals import SignalHandlerOptions
from typing_extensions import Self

from longarm_comp.core.errors import JobError
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.interfaces import Service

ANSWER_S = 60.0
"""Longest wait for an answer, s: enough for a node that starts with six others on two cores."""
FOUND_S = 10.0
"""Time, s, in which a running node is found and has reported, even on a busy machine."""
ANNOUNCED_S = 4.0
"""Time, s, in which every running node announces itself: Fast DDS does it every 3 s."""
_ASK_AGAIN_S = 0.25, 2.0
"""First and longest pause, s, before a request is repeated; each is twice the one before."""

_GET = Service("~/get_parameters", GetParameters)
_SET = Service("~/set_parameters", SetParameters)


class Interrupted(JobError):  # noqa: N818
    """A wait ended because the caller's stop event was set."""

    exit_code = 130


def count_drivers(node: Node) -> int:
    """Count the servo drivers in a node's namespace."""
    return node.count_publishers(node.resolve_topic_name(graph.DRIVER_STATE.name))


class Call:
    """A request to a service that waits for its response, and is repeated (`again`) without one."""

    def __init__(self, client: Any, request: Any, *, again: bool) -> None:
        self._client, self._request, self._again = client, request, again
        self._asked: list[Any] = []
        self._send_request(_ASK_AGAIN_S[0])

    def _send_request(self, pause_s: float) -> None:
        self._sent, self._pause = time.monotonic(), pause_s
        self._asked.append(self._client.call_async(self._request))

    def answer(self) -> Any:
        """Return the response, or None while there is none; repeat the request if it is due."""
        if self._again and time.monotonic() - self._sent > self._pause:
            self._send_request(min(2.0 * self._pause, _ASK_AGAIN_S[1]))
        return next((future.result() for future in self._asked if future.done()), None)

    def close(self) -> None:
        for future in self._asked:
            self._client.remove_pending_request(future)


class GraphClient:
    """A node that uses a graph; a context manager. ``stop`` ends every wait with `Interrupted`."""

    def __init__(
        self, namespace: str = "", stop: threading.Event | None = None, name: str = "longarm_client"
    ) -> None:
        self.stop = stop or threading.Event()
        self.context = rclpy.Context()
        rclpy.init(context=self.context, signal_handler_options=SignalHandlerOptions.NO)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.node = Node(
            name, context=self.context, namespace=namespace, start_parameter_services=False
        )
        self.executor.add_node(self.node)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ending: object) -> None:
        self.executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self.context.try_shutdown()

    def until(
        self, condition: Callable[[], Any], within_s: float, what: str | Callable[[], str]
    ) -> Any:
        """Spin until a condition is truthy and return its value.

        Args:
            within_s: longest wait, s.
            what: what is waited for, in words; or a function that makes the whole error message.

        Raises:
            JobError: the condition did not become truthy in time.
            Interrupted: ``stop`` was set.
        """
        found = self.wait(condition, within_s)
        if not found:
            said = f"{what}: not within {within_s:g} s" if isinstance(what, str) else what()
            raise JobError(said)
        return found

    def wait(self, condition: Callable[[], Any], at_most_s: float) -> Any:
        """Spin until a condition is truthy, or for ``at_most_s``, s; return its last value."""
        end = time.monotonic() + at_most_s
        while not (found := condition()):
            if self.stop.is_set():
                raise Interrupted("interrupted")
            if time.monotonic() > end:
                break
            self.executor.spin_once(timeout_sec=0.01)
        return found

    @contextmanager
    def putting_back(self) -> Iterator[None]:
        """Ignore ``stop`` in this context, for actions that must be done after an interruption."""
        stop, self.stop = self.stop, threading.Event()
        try:
            yield
        finally:
            self.stop = stop

    def spin(self, seconds: float) -> None:
        """Serve callbacks for a number of seconds. Raises Interrupted."""
        self.wait(lambda: False, seconds)

    def call(
        self, client: Any, request: Any, within_s: float = ANSWER_S, *, again: bool = False
    ) -> Any:
        """Call a service and return its response; JobError if none comes in time.

        Responses can be lost: the middleware drops one if the server has not discovered the client
        yet. A killed server is listed as available for some seconds.

        Args:
            within_s: longest wait for the service, and then for the response, s.
            again: repeat the request until a response comes. Use it only for requests that do no
                harm if they are served twice or late. To end a stop is none of them: a repetition
                could end a later stop.
        """
        self.until(client.service_is_ready, within_s, f"nobody offers {client.srv_name}")
        asked = Call(client, request, again=again)
        try:
            return self.until(asked.answer, within_s, f"no answer of {client.srv_name}")
        finally:
            asked.close()

    def ask(
        self,
        node: str,
        service: Service,
        request: Any,
        within_s: float = ANSWER_S,
        *,
        again: bool = True,
    ) -> Any:
        """Call a private service (``~/...``) of a node and return its response, as `call` does."""
        made = service.client(self.node, of=node)
        try:
            return self.call(made, request, within_s, again=again)
        finally:
            self.node.destroy_client(made)

    def parameters(self, node: str, *names: str, within_s: float = ANSWER_S) -> list[Any]:
        """Read parameters of a node, in the order of the names; None for an unknown one."""
        asked = GetParameters.Request(names=list(names))
        answer = self.ask(node, _GET, asked, within_s)
        return [parameter_value_to_python(value) for value in answer.values]

    def set_parameter(self, node: str, name: str, value: bool | float | str) -> None:
        """Set a parameter of a node. Raises JobError if the node refuses the value."""
        told = Parameter(name, value=value).to_parameter_msg()
        answer = self.ask(node, _SET, SetParameters.Request(parameters=[told]))
        if not answer.results[0].successful:
            raise JobError(answer.results[0].reason, node=node, parameter=name, value=value)


def reports_of(message: DiagnosticArray, namespace: str) -> dict[str, dict[str, DiagnosticStatus]]:
    """Return the status of the nodes in a namespace, by name of the node and of its part."""
    nodes: dict[str, dict[str, DiagnosticStatus]] = {}
    for status in message.status:
        node, colon, part = status.name.partition(": ")
        name = node.removeprefix(f"{namespace.rstrip('/')}/")
        if colon and name != node and "/" not in name:
            nodes.setdefault(name, {})[part] = status
    return nodes


class Reports:
    """Collects the reports on /diagnostics of the nodes in a client's namespace, from now on."""

    def __init__(self, client: GraphClient) -> None:
        self._client = client
        self.nodes: dict[str, dict[str, DiagnosticStatus]] = {}  # the last, by node and part
        self._heard = graph.DIAGNOSTICS.subscription(client.node, self._on_diagnostics)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for node, parts in reports_of(message, self._client.node.get_namespace()).items():
            self.nodes.setdefault(node, {}).update(parts)

    def last_message(self, node: str, part: str) -> str:
        """Return the last message of a part; empty before the first."""
        status = self.nodes.get(node, {}).get(part)
        return "" if status is None else str(status.message)

    def close(self) -> None:
        self._client.node.destroy_subscription(self._heard)
