"""The page's buttons: each calls one service of the graph and says what came of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from longarm_comp.jobs.graph_client import Call
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.interfaces import Service

_PATIENCE_S = 5.0
"""After so long without an answer a call is given up."""


@dataclass(frozen=True)
class Button:
    """A button: what it asks of which service, and what it looks like."""

    label: str
    service: Service
    request: Callable[[], Any]
    colour: tuple[int, int, int]
    hint: str


_ON, _OFF = partial(SetBool.Request, data=True), partial(SetBool.Request, data=False)
_GREY = (105, 112, 120)

STOPS = (
    Button("Software stop (torque off)", graph.ESTOP, _ON, (176, 0, 32),
           "Cuts the torque: an arm without brakes drops. It is no safety function."),
    Button("Hold", graph.HOLD, _ON, (178, 84, 0),
           "Stops smoothly and stays with torque on."),
)  # fmt: skip
RELEASES = (
    Button("Release hold", graph.HOLD, _OFF, _GREY,
           "Trajectories are taken again."),
    Button("Release stop", graph.ESTOP, _OFF, _GREY,
           "Torque on where the arm stands; trajectories are taken again."),
    Button("Reset fault", graph.RESET, Trigger.Request, _GREY,
           "Ends a fault whose cause is gone."),
)  # fmt: skip


class Buttons:
    """Calls the services without waiting. `press` may be called from any thread."""

    def __init__(self, node: Node) -> None:
        self.said = ("", True)
        """What came of the last press, in words, and whether it went well."""
        self._node = node
        self._pressed: deque[Button] = deque()
        self._calls: list[tuple[Button, Call, float]] = []
        services = {button.service for button in (*STOPS, *RELEASES)}
        self._clients = {service: service.client(node, of="servo_driver") for service in services}

    def press(self, button: Button) -> None:
        """Ask for a call; `step` makes it."""
        self._pressed.append(button)

    def step(self, now: float) -> None:
        """Send what was pressed and take the answers that have come. ``now``: monotonic, s."""
        while self._pressed:
            self._begin(self._pressed.popleft(), now)
        self._calls = [call for call in self._calls if not self._ended(*call, now)]

    def _begin(self, button: Button, now: float) -> None:
        client = self._clients[button.service]
        if not client.service_is_ready():
            name = self._node.resolve_service_name(client.srv_name)
            self._say(button, f"not done, nobody offers {name}")
            return
        self._say(button, "asked", well=True)
        asked = Call(self._node, client, button.request(), again=True)
        self._calls.append((button, asked, now))

    def _ended(self, button: Button, asked: Call, since: float, now: float) -> bool:
        """Whether a call is answered or given up."""
        answer = asked.answer()
        if answer is None and now - since < _PATIENCE_S:
            return False
        asked.close()
        if answer is None:
            self._say(button, f"no answer in {_PATIENCE_S:g} s, so perhaps not done")
        else:
            well = answer.success
            self._say(button, answer.message if well else f"refused: {answer.message}", well=well)
        return True

    def _say(self, button: Button, what: str, *, well: bool = False) -> None:
        self.said = (f"{button.label}: {what}", well)
