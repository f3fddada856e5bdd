"""The page's panel: state in words, buttons, sliders, health and progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from typing import Any

import viser

from longarm_comp.view import words
from longarm_comp.view.commands import RELEASES, STOPS, Button
from longarm_comp.view.state import PageState

_BAD, _DOUBTFUL, _GOOD = "#b00020", "#8a4b00", "inherit"


class Panel:
    """Handles of the panel. Texts of the graph are escaped: they may hold anything."""

    def __init__(
        self, server: viser.ViserServer, press: Callable[[Button], None], namespace: str
    ) -> None:
        self._namespace, gui = namespace, server.gui
        gui.set_panel_label(f"longarm view {namespace}")
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._state = gui.add_html("")
        for button in STOPS:
            made = gui.add_button(button.label, color=button.colour, hint=button.hint)
            made.on_click(partial(_pressed, press, button))
        named = {button.label: button for button in RELEASES}
        hints = "\n".join(f"{button.label}: {button.hint}" for button in RELEASES)
        group = gui.add_button_group("", tuple(named), hint=hints)
        group.on_click(lambda event: press(named[event.target.value]))
        self._said = gui.add_html("")
        self._job = gui.add_html("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._tip = gui.add_html("")
        with gui.add_folder("Health"):
            self._health = gui.add_html("")
        self._deflection = gui.add_slider("Deflection ×", min=1, max=100, step=1, initial_value=10)
        self._error = gui.add_slider("Error arrows ×", min=1, max=500, step=1, initial_value=100)
        self._scale = gui.add_html("")

    @property
    def exaggeration(self) -> tuple[float, float]:
        """How many times larger the deflection, and how many times longer error arrows are."""
        return self._deflection.value, self._error.value

    def show(self, state: PageState, now: float, said: tuple[str, bool]) -> None:
        """Show a state, and what came of the last press of a button."""
        colour = _BAD if state.unread_s(now) else _GOOD
        headline = words.headline(state, now, self._namespace)
        self._write(self._state, [_line(headline, colour, bold=True), _line(words.target(state))])
        text, well = said
        self._write(self._said, [_line(text, _GOOD if well else _BAD)] if text else [])
        told = [words.tip_at_target(state, now), words.tip_as_predicted(state, now)]
        known = (*told, words.ring(state), words.drift(state), words.learned(state))
        self._write(self._tip, [_line(text) for text in known if text])
        scale = words.exaggeration(*self.exaggeration)
        self._write(self._scale, [_line(scale), _line(words.LEGEND)])
        self._show_health(state, now)
        if state.progress is not None:
            job = state.progress
            self._write(self._job, [_line(words.progress(job, now))])
            _set(self._bar, "value", 100.0 * min(job.done / job.of, 1.0))
            for handle in (self._job, self._bar):
                _set(handle, "visible", True)

    def _show_health(self, state: PageState, now: float) -> None:
        lines, colours = [], {words.WELL: _GOOD, words.WARNING: _DOUBTFUL}
        for name in sorted(state.nodes):
            for k, text in enumerate(words.health(state.nodes[name], now)):
                lines.append(_line(text, colours.get(text[0], _BAD), bold=k == 0, indent=k > 0))
        self._write(self._health, lines or [_line("no node has reported yet")])

    @staticmethod
    def _write(handle: Any, lines: Sequence[str]) -> None:
        style = "font-size:0.85em;line-height:1.4;padding:0 0.75em;overflow-wrap:anywhere"
        _set(handle, "content", f"<div style='{style}'>{''.join(lines)}</div>" if lines else "")


def _pressed(press: Callable[[Button], None], button: Button, _: object) -> None:
    press(button)


def _line(text: str, colour: str = _GOOD, *, bold: bool = False, indent: bool = False) -> str:
    style = f"color:{colour};font-weight:{'bold' if bold else 'normal'}"
    return f"<div style='{style};padding-left:{1 if indent else 0}em'>{escape(text)}</div>"


def _set(handle: Any, name: str, value: Any) -> None:
    """Set a property of a handle where it changes: every assignment is sent to the browsers."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)
