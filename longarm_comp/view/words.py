"""The page's sentences."""

from __future__ import annotations

import math
import os

import numpy as np

from longarm_comp.view.state import NodeHealth, PageState

WELL, WARNING, BAD, SILENT = "●", "▲", "✖", "■"
LEVELS = ((WELL, "well"), (WARNING, "warning"), (BAD, "error"), (SILENT, "stale"))
"""Signs and words of the levels on /diagnostics, so that colour is not needed."""


def headline(state: PageState, now: float, namespace: str) -> str:
    """Whether the graph speaks, and what the arm does."""
    silent = state.silent_s(now)
    if math.isinf(silent):
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        return (
            f"Nothing received yet in namespace {namespace} of ROS domain {domain}. "
            "Is the graph up (longarm up)?"
        )
    if silent:
        return f"The graph is silent for {_ago(silent)}. The page shows its last state."
    unread = state.unread_s(now)
    if unread:
        return f"No joint_states{'' if math.isinf(unread) else f' for {_ago(unread)}'}."
    words, why = state.driver
    if not words:
        return "Joint readings arrive; no driver reports its state."
    return f"The driver is {words}{f' ({why})' if why else ''}."


def sections(state: PageState, now: float, namespace: str, said: str) -> dict[str, list[str]]:
    """All that the page says, by place; ``said``: what came of the last press of a button."""
    lines = {
        "state": [headline(state, now, namespace), target(state)],
        "said": [said],
        "job": [progress(state, now)],
        "tip": [tip_at_target(state, now), tip_as_predicted(state, now), drift(state),
                *(f"{what}: {told}." for what, told in state.told.items())],
        "health": [line for name in sorted(state.nodes) for line in health(state.nodes[name], now)]
        or ["no node has reported yet"],
    }  # fmt: skip
    return {place: [line for line in found if line] for place, found in lines.items()}


def target(state: PageState) -> str:
    if state.answer is None:
        return "No target since this page was opened."
    why = f": {state.answer.message}" if state.answer.message else ""
    sent = "" if state.answer.sent else ", nothing sent"
    return f"Last target: {state.answer.status}{sent}{why}."


def tip_at_target(state: PageState, now: float) -> str:
    """tip - target, or why there is none."""
    found = state.missed(now)
    return f"tip − target: {_no_error(state, now) if found is None else millimetres(found)}"


def tip_as_predicted(state: PageState, now: float) -> str:
    """tip - predicted tip, or why there is none."""
    found = state.unpredicted(now)
    return f"tip − predicted: {_no_error(state, now) if found is None else millimetres(found)}"


def _no_error(state: PageState, now: float) -> str:
    if state.seen_tip(now) is None:
        return "no camera sees the tip"
    if state.picture is None:
        return "kinematics has shown no arm yet"
    if not state.resting:
        return "the arm moves"
    if state.answer is None:
        return "no target was heard since this page was opened"
    return "the arm is not at the last target"


def millimetres(vector: np.ndarray) -> str:
    """Length and components of a vector (3,) in m."""
    parts = ", ".join(
        f"{axis} {1e3 * part:+.2f}" for axis, part in zip("xyz", vector.tolist(), strict=True)
    )
    return f"{1e3 * math.dist((0.0, 0.0, 0.0), vector.tolist()):.2f} mm ({parts})"


LEGEND = (
    "Grey: the arm as declared, rigid. Blue: as predicted. Green: target. Yellow: pseudo-target. "
    "Red: tip, and tip − target. Orange: tip − predicted."
)


def exaggeration(deflection: float, error: float) -> str:
    """What is drawn larger than it is."""
    bent = "to scale" if deflection == 1.0 else f"{deflection:g} times larger than it is"
    arrows = "to scale" if error == 1.0 else f"{error:g} times longer than they are"
    drawn = f"The blue arm's deflection is drawn {bent}, error arrows {arrows}."
    return f"{drawn} Everything else is to scale."


def drift(state: PageState) -> str:
    """How near the test of drift is to a warning."""
    if math.isnan(state.evidence):
        return "Drift: nothing judged yet."
    warns = "warns" if state.evidence >= 1.0 else "does not warn"
    return f"Drift: evidence {state.evidence:.2f} of 1; the test {warns}."


def progress(state: PageState, now: float) -> str:
    """How far a collection is; empty where none was heard of."""
    job = state.progress
    if job is None:
        return ""
    heard = f"; heard {_ago(now - job.at)} ago" if now - job.at > 5.0 else ""
    return f"collect: {job.message}{heard}"


def health(node: NodeHealth, now: float) -> list[str]:
    """A node in one line, and one for each of its parts that is not well; a sign first."""
    silent = node.silent_s(now)
    if silent:
        return [f"{SILENT} {node.name}: silent for {_ago(silent)}"]
    sign, word = LEVELS[max(part.level for part in node.parts)]
    ill = [part for part in node.parts if part.level]
    return [
        f"{sign} {node.name}: {word}",
        *(f"{LEVELS[part.level][0]} {part.name}: {part.message}" for part in ill),
    ]


def _ago(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
