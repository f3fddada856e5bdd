"""The same page without a scene: text and the buttons, for a browser without WebGL."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from html import escape

from longarm_comp.view.commands import Button

PATH = "/plain"
START = f"""<!doctype html><title>longarm view</title>
<noscript><a href="{PATH}">state and buttons as plain text</a></noscript>
<script>const c = document.createElement("canvas");
location.replace(c.getContext("webgl2") || c.getContext("webgl") ? "/" : "{PATH}")</script>
"""
"""Leads on to the scene where the browser can draw it, else to the plain page."""
_STYLE = """body{font:16px sans-serif;max-width:40em;margin:1em auto}
a{display:inline-block;padding:.8em 1.2em;margin:.3em .3em .3em 0;color:#fff;border-radius:.3em}"""


class PlainPage:
    """What is served below `PATH`. A press has a drawn key in its address: no other page knows it.

    Attributes:
        lines: of the state; the page asks for them once a second.
    """

    def __init__(self, buttons: Sequence[Button], press: Callable[[Button], None]) -> None:
        self.lines: Sequence[str] = ()
        self._press = press
        key = secrets.token_urlsafe(24)
        self._buttons = {f"{PATH}/{key}/{k}": button for k, button in enumerate(buttons)}

    def answer(self, path: str) -> str | None:
        """The page at a path; empty: a button was pressed, look at `PATH`; None: no such page."""
        if path in self._buttons:
            self._press(self._buttons[path])
            return ""
        if path != PATH:
            return None
        links = "".join(
            f'<a href="{at}" title="{escape(button.hint)}" '
            f'style="background:rgb{button.colour}">{escape(button.label)}</a>'
            for at, button in self._buttons.items()
        )
        told = "".join(f"<p>{escape(line)}</p>" for line in self.lines)
        return (f'<!doctype html><meta http-equiv="refresh" content="1"><title>longarm view</title>'
                f"<style>{_STYLE}</style>{links}{told}")  # fmt: skip
