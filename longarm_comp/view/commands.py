"""The page's buttons: each calls one service of the graph and says what came of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.interfaces import Service

_AGAIN_S, _PATIENCE_S = 1.0, 5.0
"""A call is sent again, and given up."""


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


@dataclass
class _Call:
    button: Button
    since: float
    asked: list[Any] = field(default_factory=list)
    sent: float = 0.0


class Buttons:
    """Calls the services without waiting. `press` may be called from any thread."""

    def __init__(self, node: Node) -> None:
        self.said = ("", True)
        """What came of the last press, in words, and whether it went well."""
        self._node = node
        self._pressed: deque[Button] = deque()
        self._calls: list[_Call] = []
        services = {button.service for button in (*STOPS, *RELEASES)}
        self._clients = {service: service.client(node, of="servo_driver") for service in services}

    def press(self, button: Button) -> None:
        """Ask for a call; `step` makes it."""
        self._pressed.append(button)

    def step(self, now: float) -> None:
        """Send what was pressed and take the answers that have come. ``now``: monotonic, s."""
        while self._pressed:
            self._begin(self._pressed.popleft(), now)
        self._calls = [call for call in self._calls if not self._ended(call, now)]

    def _begin(self, button: Button, now: float) -> None:
        client = self._clients[button.service]
        if not client.service_is_ready():
            name = self._node.resolve_service_name(client.srv_name)
            self._say(button, f"not done, nobody offers {name}")
            return
        self._say(button, "asked", well=True)
        self._calls.append(_Call(button, now))

    def _ended(self, call: _Call, now: float) -> bool:
        """Send a call, once more where no answer came, until it is answered or given up."""
        client = self._clients[call.button.service]
        done = next((future for future in call.asked if future.done()), None)
        if done is None and now - call.since < _PATIENCE_S:
            if not call.asked or now - call.sent > _AGAIN_S:
                call.asked.append(client.call_async(call.button.request()))
                call.sent = now
            return False
        for waiting in call.asked:
            client.remove_pending_request(waiting)
        if done is None:
            self._say(call.button, f"no answer in {_PATIENCE_S:g} s, so perhaps not done")
        elif done.result().success:
            self._say(call.button, done.result().message, well=True)
        else:
            self._say(call.button, f"refused: {done.result().message}")
        return True

    def _say(self, button: Button, what: str, *, well: bool = False) -> None:
        self.said = (f"{button.label}: {what}", well)
