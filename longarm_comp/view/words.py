"""The page's sentences."""

from __future__ import annotations

import math
import os

import numpy as np

from longarm_comp.view.state import CollectProgress, NodeHealth, PageState

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


def in_lines(state: PageState, now: float, namespace: str, said: str) -> list[str]:
    """All that the panel says, as lines; ``said``: what came of the last press of a button."""
    lines = [said, headline(state, now, namespace), target(state), tip_at_target(state, now),
             tip_as_predicted(state, now), ring(state), drift(state), learned(state)]  # fmt: skip
    if state.progress is not None:
        lines.append(progress(state.progress, now))
    lines += [line for name in sorted(state.nodes) for line in health(state.nodes[name], now)]
    return [line for line in lines if line]


def target(state: PageState) -> str:
    """What became of the last target."""
    if state.answer is None:
        return "No target since this page was opened."
    why = f": {state.answer.message}" if state.answer.message else ""
    sent = "" if state.answer.sent else ", nothing sent"
    return f"Last target: {state.answer.status}{sent}{why}."


def tip_at_target(state: PageState, now: float) -> str:
    """tip - target, or why there is none."""
    return _error("tip − target", state.missed(now), state, now)


def tip_as_predicted(state: PageState, now: float) -> str:
    """tip - predicted tip, or why there is none."""
    return _error("tip − predicted", state.unpredicted(now), state, now)


def _error(what: str, found: np.ndarray | None, state: PageState, now: float) -> str:
    return f"{what}: {_no_error(state, now) if found is None else millimetres(found)}"


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


def progress(job: CollectProgress, now: float) -> str:
    """How far a job is."""
    heard = f"; heard {_ago(now - job.at)} ago" if now - job.at > 5.0 else ""
    count = f"{job.done} of {job.of}"
    said = job.message if job.message.startswith(count) else f"{count}, {job.message}"
    return f"{job.job}: {said}{heard}"


def learned(state: PageState) -> str:
    """What was learned at work."""
    return f"At work: {state.learned}." if state.learned else ""


def ring(state: PageState) -> str:
    """How the tip rings after the last move."""
    return f"After the last move: {state.ring}." if state.ring else ""


def health(node: NodeHealth, now: float) -> list[str]:
    """A node in one line, and one for each of its parts that is not well; a sign first."""
    silent = node.silent_s(now)
    if silent:
        return [f"{SILENT} {node.name}: silent for {_ago(silent)}"]
    sign, word = _level(max(part.level for part in node.parts))
    ill = [part for part in node.parts if part.level]
    return [
        f"{sign} {node.name}: {word}",
        *(f"{_level(part.level)[0]} {part.name}: {part.message}" for part in ill),
    ]


def _level(level: int) -> tuple[str, str]:
    return LEVELS[min(level, len(LEVELS) - 1)]


def _ago(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
