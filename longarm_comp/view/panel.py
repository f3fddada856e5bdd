"""The page's panel: state in words, buttons, sliders, health and progress."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from html import escape
from typing import Any

import viser

from longarm_comp.view import words
from longarm_comp.view.commands import RELEASES, STOPS, Button
from longarm_comp.view.state import PageState

_BAD = "#b00020"
_SIGNS = {words.WARNING: "#8a4b00", words.BAD: _BAD, words.SILENT: _BAD}


class Panel:
    """Handles of the panel. Texts of the graph are escaped: they may hold anything."""

    def __init__(
        self, server: viser.ViserServer, press: Callable[[Button], None], namespace: str
    ) -> None:
        gui = server.gui
        gui.set_panel_label(f"longarm view {namespace}")
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._places = {"state": gui.add_html("")}
        for button in STOPS:
            made = gui.add_button(button.label, color=button.colour, hint=button.hint)
            made.on_click(partial(_pressed, press, button))
        named = {button.label: button for button in RELEASES}
        hints = "\n".join(f"{button.label}: {button.hint}" for button in RELEASES)
        group = gui.add_button_group("", tuple(named), hint=hints)
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
        """How many times larger the deflection, and how many times longer error arrows are."""
        return self._deflection.value, self._error.value

    def show(
        self, state: PageState, now: float, lines: Mapping[str, Sequence[str]], *, well: bool
    ) -> None:
        """Show what `words.sections` says; ``well``: how the last press of a button went."""
        colours = {"state": _BAD if state.unread_s(now) else "", "said": "" if well else _BAD}
        heads = {
            *lines["state"][:1],
            *(text for text in lines["health"] if _of(text) in state.nodes),
        }
        scale = [words.exaggeration(*self.exaggeration), words.LEGEND]
        for place, texts in {**lines, "scale": scale}.items():
            html = "".join(_line(text, colours.get(place, ""), text in heads) for text in texts)
            _set(self._places[place], "content", html and f"<div style='{_STYLE}'>{html}</div>")
        if state.progress is not None:
            _set(self._bar, "value", 100.0 * min(state.progress.share, 1.0))
            _set(self._bar, "visible", True)


_STYLE = "font-size:0.85em;line-height:1.4;padding:0 0.75em;overflow-wrap:anywhere"


def _of(text: str) -> str:
    """The node that a line of the health begins with, after its sign."""
    return text[2:].partition(": ")[0]


def _pressed(press: Callable[[Button], None], button: Button, _: object) -> None:
    press(button)


def _line(text: str, colour: str, head: bool) -> str:
    style = f"color:{_SIGNS.get(text[0], colour)};font-weight:{'bold' if head else 'normal'}"
    return f"<div style='{style}'>{escape(text)}</div>"


def _set(handle: Any, name: str, value: Any) -> None:
    """Set a property of a handle where it changes: every assignment is sent to the browsers."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)
