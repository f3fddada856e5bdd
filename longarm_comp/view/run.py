"""Runs the page: one thread listens to the graph and draws, viser's threads serve the browsers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.view import words
from longarm_comp.view.listener import Listener
from longarm_comp.view.panel import RELEASES, STOPS, Buttons, Panel
from longarm_comp.view.scene import Scene
from longarm_comp.view.server import Gate, PlainPage, serving


def view(
    namespace: str, port: int, stop: threading.Event, opened: Callable[[Callable[[], str]], None]
) -> None:
    """Show the graph of a namespace until ``stop`` is set.

    Args:
        port: of the page, on the loopback address; the next free one where it is taken, and any
            free one for 0.
        opened: gets what draws a link to the page; each opens it once.
    """
    with GraphClient(namespace, stop, "view") as client, ExitStack() as open_page:
        listener, commands = Listener(client), Buttons(client.node)
        plain = PlainPage((*STOPS, *RELEASES), commands.press)
        gate = Gate(plain=plain.answer)
        server = open_page.enter_context(serving(port, gate))
        panel = Panel(server, commands.press, client.node.get_namespace())
        scene = Scene(server)
        opened(partial(gate.link, server.get_port()))
        drawn = 0.0
        while not stop.is_set():
            client.executor.spin_once(timeout_sec=0.02)
            now = time.monotonic()
            commands.step(now)
            if now - drawn >= 0.2:  # s between two pictures
                drawn = now
                said, well = commands.said
                lines = words.sections(listener.state, now, namespace, said)
                panel.show(listener.state, now, lines, well=well)
                plain.lines = [line for place in lines.values() for line in place]
                scene.show(listener.state, now, panel.exaggeration)
