"""The page's panel: state in words, buttons that call services of the graph, sliders, health."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from typing import Any

import viser
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from longarm_comp.jobs.graph_client import Call
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.interfaces import Service
from longarm_comp.view import words
from longarm_comp.view.words import PageState

_PATIENCE_S = 5.0
"""Time (s) without an answer after which a call is given up."""


@dataclass(frozen=True)
class Button:
    """A button: the service that it calls, its request, and what it looks like."""

    label: str
    hint: str
    service: Service
    request: Callable[[], Any]
    colour: tuple[int, int, int] = (105, 112, 120)


_ON, _OFF = partial(SetBool.Request, data=True), partial(SetBool.Request, data=False)
_DROPS = "Cuts the torque: an arm without brakes drops. It is no safety function."
_STAYS = "Stops smoothly and stays with torque on."
_DRIVEN = "Torque on where the arm stands; trajectories are taken again."
_CURED = "Ends stop, hold, and a fault whose cause is gone."

STOPS = (
    Button("Software stop (torque off)", _DROPS, graph.ESTOP, _ON, (176, 0, 32)),
    Button("Hold", _STAYS, graph.HOLD, _ON, (178, 84, 0)),
)
RELEASES = (
    Button("Release hold", "Trajectories are taken again.", graph.HOLD, _OFF),
    Button("Release stop", _DRIVEN, graph.ESTOP, _OFF),
    Button("Reset fault", _CURED, graph.RESET, Trigger.Request),
)


class Buttons:
    """Calls the services without waiting. `press` may be called from any thread."""

    def __init__(self, node: Node) -> None:
        self.said = ("", True)
        """The result of the last press in words, and whether it went well."""
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
            button = self._pressed.popleft()
            client = self._clients[button.service]
            if client.service_is_ready():
                self._note_said(button, "asked", well=True)
                asked = Call(client, button.request(), again=button in STOPS)
                self._calls.append((button, asked, now))
            else:
                name = self._node.resolve_service_name(client.srv_name)
                self._note_said(button, f"not done, nobody offers {name}")
        self._calls = [call for call in self._calls if not self._has_ended(*call, now)]

    def _has_ended(self, button: Button, asked: Call, since: float, now: float) -> bool:
        """Return whether a call is answered or given up."""
        answer = asked.answer()
        if answer is None and now - since < _PATIENCE_S:
            return False
        asked.close()
        if answer is None:
            self._note_said(button, f"no answer in {_PATIENCE_S:g} s, so perhaps not done")
        else:
            well = answer.success
            self._note_said(
                button, answer.message if well else f"refused: {answer.message}", well=well
            )
        return True

    def _note_said(self, button: Button, what: str, *, well: bool = False) -> None:
        self.said = (f"{button.label}: {what}", well)


_BAD = "#b00020"
_SIGNS = {words.WARNING: "#8a4b00", words.BAD: _BAD, words.SILENT: _BAD}


class Panel:
    """The panel. Texts from the graph are escaped, as they may hold anything."""

    def __init__(
        self, server: viser.ViserServer, press: Callable[[Button], None], namespace: str
    ) -> None:
        gui = server.gui
        gui.set_panel_label(f"longarm view {namespace}")
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._places = {"state": gui.add_html("")}
        named = {button.label: button for button in (*STOPS, *RELEASES)}
        for button in STOPS:
            made = gui.add_button(button.label, color=button.colour, hint=button.hint)
            made.on_click(lambda event: press(named[event.target.label]))
        hints = "\n".join(f"{button.label}: {button.hint}" for button in RELEASES)
        group = gui.add_button_group("", [button.label for button in RELEASES], hint=hints)
        group.on_click(lambda event: press(named[event.target.value]))
        self._places |= {"said": gui.add_html(""), "job": gui.add_html("")}
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._places["tip"] = gui.add_html("")
        with gui.add_folder("Health"):
            self._places["health"] = gui.add_html("")
        self._deflection = gui.add_slider("Deflection ×", min=1, max=100, step=1, initial_value=10)
        self._error = gui.add_slider("Error arrows ×", min=1, max=500, step=1, initial_value=100)
        self._places["scale"] = gui.add_html("")

    @property
    def exaggeration(self) -> tuple[float, float]:
        """The factors by which the deflection and the error arrows are drawn larger."""
        return self._deflection.value, self._error.value

    def show(
        self, state: PageState, now: float, lines: Mapping[str, Sequence[str]], *, well: bool
    ) -> None:
        """Show the lines of `words.list_lines`; ``well``: the last press of a button went well."""
        colours = {"state": _BAD if state.unread_s(now) else "", "said": "" if well else _BAD}
        # A line of a node's health is a sign, a blank, its name and how it is
        nodes = [line for line in lines["health"] if line[2:].partition(": ")[0] in state.nodes]
        heads = {*lines["state"][:1], *nodes}
        scale = [words.describe_scale(*self.exaggeration), words.LEGEND]
        for place, texts in {**lines, "scale": scale}.items():
            html = "".join(_line_of(text, colours.get(place, ""), text in heads) for text in texts)
            _set_new(self._places[place], "content", html and f"<div style='{_STYLE}'>{html}</div>")
        if state.progress is not None:
            _set_new(self._bar, "value", 100.0 * min(state.progress.share, 1.0))
            _set_new(self._bar, "visible", True)


_STYLE = "font-size:0.85em;line-height:1.4;padding:0 0.75em;overflow-wrap:anywhere"


def _line_of(text: str, colour: str, head: bool) -> str:
    style = f"color:{_SIGNS.get(text[0], colour)};font-weight:{'bold' if head else 'normal'}"
    return f"<div style='{style}'>{escape(text)}</div>"


def _set_new(handle: Any, name: str, value: Any) -> None:
    """Set a property of a handle where it changes: every assignment is sent to the browsers."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)
