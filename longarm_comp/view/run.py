"""The program of the page: it collects the messages of an arm's graph and draws them.

One thread listens to the graph and draws, viser's threads serve the browsers.
"""

import math
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from longarm_comp.core.at_work import LEARNED_SAID
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.model.link_frames import exaggerate_sag
from longarm_comp.jobs.graph_client import GraphClient, reports_of
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import RING_SAID
from longarm_comp.nodes.messages import driver_words, sighting_of
from longarm_comp.nodes.monitoring import EVIDENCE
from longarm_comp.view import words
from longarm_comp.view.panel import RELEASES, STOPS, Buttons, Panel
from longarm_comp.view.scene import Scene
from longarm_comp.view.server import Gate, PlainPage, serve_page
from longarm_comp.view.words import CollectProgress, LastAnswer, PageState, Part, Picture
from longarm_interfaces.msg import Compensation, DriverState


class Listener:
    """Subscribes to an arm's topics; `state` holds their latest messages."""

    def __init__(self, client: GraphClient) -> None:
        self.state, self._namespace = PageState(), client.node.get_namespace()
        self._base = ""  # frame of the pictures
        for topic, callback in (
            (graph.MARKERS, self._on_markers),
            (graph.TIP_SEEN, self._on_tip),
            (graph.JOINT_STATES, self._on_joints),
            (graph.DRIVER_STATE, self._on_driver),
            (graph.COMPENSATION, self._on_answer),
            (graph.DIAGNOSTICS, self._on_diagnostics),
            (graph.COLLECT_PROGRESS, self._on_progress),
        ):
            topic.subscription(client.node, callback)

    def _update_state(self, **changes: Any) -> None:
        self.state = replace(self.state, heard=time.monotonic(), **changes)

    def _on_markers(self, message: MarkerArray) -> None:
        lines = {marker.ns: marker for marker in message.markers}
        self._base = message.markers[0].header.frame_id if message.markers else self._base
        points = {
            name: np.array([[p.x, p.y, p.z] for p in marker.points]).reshape(-1, 3)
            for name, marker in lines.items()
        }
        declared, drawn = points.get("declared", _NONE), points.get("hanging", _NONE)
        factor = _to_number(lines["hanging"].text) if "hanging" in lines else math.nan
        if declared.shape != drawn.shape or not len(drawn) or not factor > 0.0:
            return
        hanging = exaggerate_sag(drawn, declared, 1.0 / factor)
        target, pseudo = (
            points[name][0] if len(points.get(name, _NONE)) else None
            for name in ("target", "pseudo_target")
        )
        self._update_state(picture=Picture(declared, hanging, target, pseudo, time.monotonic()))

    def _on_tip(self, message: PoseWithCovarianceStamped) -> None:
        if message.header.frame_id == self._base:  # else nobody knows where it lies
            self._update_state(tip=sighting_of(message)[0], tip_at=time.monotonic())

    def _on_joints(self, message: JointState) -> None:
        joints = dict(zip(message.name, message.position, strict=False))
        self.state = self.state.with_joints(joints, time.monotonic())
        self._update_state()

    def _on_driver(self, message: DriverState) -> None:
        self._update_state(driver=(driver_words(message.state), message.message))

    def _on_answer(self, message: Compensation) -> None:
        known = message.status in set(Status)
        status = Status(message.status).name if known else f"status {message.status}"
        sent = dict(zip(message.executed.name, message.executed.position, strict=False))
        self._update_state(answer=LastAnswer(status, message.message, sent))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for node, parts in reports_of(message, self._namespace).items():
            health = tuple(Part(name, min(ord(s.level), 3), s.message) for name, s in parts.items())
            told = {said: parts[name].message for name, said in _TOLD.items() if name in parts}
            self.state = self.state.with_report(node, health, time.monotonic())
            self._update_state(told={**self.state.told, **told})
            if "monitor" in parts:
                facts = {value.key: value.value for value in parts["monitor"].values}
                self._update_state(evidence=_to_number(facts.get(EVIDENCE, "")))

    def _on_progress(self, message: DiagnosticStatus) -> None:
        facts = {value.key: value.value for value in message.values}
        share = _to_number(facts.get("done", "")) / max(1.0, _to_number(facts.get("total", "")))
        if math.isfinite(share):
            self._update_state(progress=CollectProgress(share, message.message, time.monotonic()))


_TOLD = {RING_SAID: "After the last move", LEARNED_SAID: "At work"}
"""By part of /diagnostics: the heading under which the page repeats its message."""
_NONE = np.empty((0, 3))


def _to_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def view(
    namespace: str, port: int, stop: threading.Event, open_link: Callable[[Callable[[], str]], None]
) -> None:
    """Show the graph of a namespace until ``stop`` is set.

    Args:
        port: port of the page on the loopback address; if it is taken, the next free one; 0: any.
        open_link: gets a function that makes links to the page; each link works once.
    """
    with GraphClient(namespace, stop, "view") as client, ExitStack() as open_page:
        listener, commands = Listener(client), Buttons(client.node)
        plain = PlainPage((*STOPS, *RELEASES), commands.press)
        gate = Gate(plain=plain.answer)
        server = open_page.enter_context(serve_page(port, gate))
        panel = Panel(server, commands.press, client.node.get_namespace())
        scene = Scene(server)
        open_link(partial(gate.link, server.get_port()))
        drawn = 0.0
        while not stop.is_set():
            client.executor.spin_once(timeout_sec=0.02)
            now = time.monotonic()
            commands.step(now)
            if now - drawn >= 0.2:  # s between two pictures
                drawn = now
                said, well = commands.said
                lines = words.list_lines(listener.state, now, namespace, said)
                panel.show(listener.state, now, lines, well=well)
                plain.lines = [line for place in lines.values() for line in place]
                scene.show(listener.state, now, panel.exaggeration)
