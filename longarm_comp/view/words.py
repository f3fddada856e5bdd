"""The latest messages of the graph, as one frozen record and as the sentences of the page."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from longarm_comp.core.data.rest import JOINT_REST

_SILENT_S = 3.0
"""Time (s) without any message after which the graph is silent: joints come many times a second."""


@dataclass(frozen=True, eq=False)
class Picture:
    """The arm as topic `markers` shows it, to scale, m: (k, 3) from foot to tip; targets (3,)."""

    declared: np.ndarray
    hanging: np.ndarray
    target: np.ndarray | None
    pseudo_target: np.ndarray | None
    at: float


@dataclass(frozen=True)
class LastAnswer:
    """The answer to the last target: status, reason, and joints sent, by name (none: not sent)."""

    status: str
    message: str
    sent: Mapping[str, float]


@dataclass(frozen=True)
class Part:
    """One part of a node on /diagnostics; level 0 well, 1 warning, 2 error, 3 stale."""

    name: str
    level: int
    message: str


@dataclass(frozen=True)
class NodeHealth:
    """The reports of a node, and when it sent the last one."""

    name: str
    parts: tuple[Part, ...]
    at: float
    every_s: float = 0.0

    def silent_s(self, now: float) -> float:
        """Return for how long (s) the node has been silent; 0 while it reports in time."""
        return _find_silence(self.at, now, max(5.0, 3.0 * self.every_s))


@dataclass(frozen=True)
class CollectProgress:
    """The progress of a collection: share of its plan, 0 to 1, and words."""

    share: float
    message: str
    at: float


@dataclass(frozen=True, eq=False)
class PageState:
    """Everything that the page shows. Times are monotonic, s."""

    heard: float | None = None  # when any message came last
    picture: Picture | None = None
    tip: np.ndarray | None = None  # (3,) m, as the cameras saw it last; NaN: marker lost
    tip_at: float = -math.inf  # when `tip` came
    joints: Mapping[str, float] = field(default_factory=dict)  # last reading by name, rad and m
    read: float | None = None  # when the joints were read last
    moved: float = -math.inf  # when a joint moved last by more than `JOINT_REST`
    driver: tuple[str, str] = ("", "")  # its state in a word, and the reason
    answer: LastAnswer | None = None
    nodes: Mapping[str, NodeHealth] = field(default_factory=dict)
    progress: CollectProgress | None = None
    evidence: float = math.nan  # of drift; at 1 or more a warning is given; NaN: not judged
    told: Mapping[str, str] = field(default_factory=dict)  # further messages, by their heading
    seed: Mapping[str, float] = field(default_factory=dict)  # the joints at `moved`

    def with_joints(self, joints: Mapping[str, float], now: float) -> PageState:
        if _same_joints(joints, self.seed):
            return replace(self, joints=joints, read=now)
        return replace(self, joints=joints, read=now, seed=joints, moved=now)

    def with_report(self, node: str, parts: tuple[Part, ...], now: float) -> PageState:
        before = self.nodes.get(node)
        every = 0.0 if before is None else now - before.at
        return replace(
            self, nodes={**self.nodes, node: NodeHealth(node, parts, now, min(every, 60.0))}
        )

    def silent_s(self, now: float) -> float:
        """Return for how long (s) the graph has been silent; infinite if it always was."""
        return _find_silence(self.heard, now, _SILENT_S)

    def unread_s(self, now: float) -> float:
        """Return for how long (s) no joint readings have come; 0 and infinite as in `silent_s`."""
        return _find_silence(self.read, now, _SILENT_S)

    def is_old(self, now: float) -> bool:
        """Return whether the picture of the arm is out of date at `now` (s)."""
        at = None if self.picture is None else self.picture.at
        return bool(self.unread_s(now) or _find_silence(at, now, 5.0))

    def seen_tip(self, now: float) -> np.ndarray | None:
        """Return the tip (3,) m that is seen now; None where it is not."""
        if self.tip is None or now - self.tip_at >= 3.0 or np.isnan(self.tip).any():
            return None
        return self.tip

    @property
    def resting(self) -> bool:
        """True if picture and sighting both show the arm at rest."""
        if self.picture is None:
            return False
        # A picture is a half second old, and a sighting some frames
        return min(self.picture.at, self.tip_at) > self.moved + 0.6

    def miss_at_target(self, now: float) -> np.ndarray | str:
        """Return tip - target (3,) m, if the arm rests at its target and is seen; else why not."""
        beside = self.miss_of_prediction(now)
        if isinstance(beside, str):
            return beside
        assert self.tip is not None and self.picture is not None
        if self.answer is None:
            return "no target was heard since this page was opened"
        if self.picture.target is None or not _same_joints(self.answer.sent, self.joints):
            return "the arm is not at the last target"
        return self.tip - self.picture.target

    def miss_of_prediction(self, now: float) -> np.ndarray | str:
        """Return tip - predicted tip (3,) m, where the arm rests and is seen; else why not."""
        tip = self.seen_tip(now)
        if tip is None:
            return "no camera sees the tip"
        if self.picture is None:
            return "kinematics has shown no arm yet"
        return tip - self.picture.hanging[-1] if self.resting else "the arm moves"


def _find_silence(last: float | None, now: float, allowed: float) -> float:
    """Return the time (s) since ``last`` if it is longer than allowed, else 0."""
    quiet = math.inf if last is None else now - last
    return quiet if quiet > allowed else 0.0


def _same_joints(sent: Mapping[str, float], joints: Mapping[str, float]) -> bool:
    """Return whether joints were sent and all of them stand there, within `JOINT_REST`."""
    return bool(sent) and all(
        name in joints and abs(joints[name] - value) <= JOINT_REST for name, value in sent.items()
    )


WELL, WARNING, BAD, SILENT = "●", "▲", "✖", "■"
LEVELS = ((WELL, "well"), (WARNING, "warning"), (BAD, "error"), (SILENT, "stale"))
"""Signs and words of the levels on /diagnostics, so that colour is not needed."""


def say_headline(state: PageState, now: float, namespace: str) -> str:
    """Say whether the graph sends messages, and the state of the driver."""
    silent = state.silent_s(now)
    if math.isinf(silent):
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        return (
            f"Nothing received yet in namespace {namespace} of ROS domain {domain}. "
            "Is the graph up (longarm up)?"
        )
    if silent:
        return f"The graph is silent for {_format_ago(silent)}. The page shows its last state."
    if unread := state.unread_s(now):
        return f"No joint_states{'' if math.isinf(unread) else f' for {_format_ago(unread)}'}."
    words, why = state.driver
    if not words:
        return "Joint readings arrive; no driver reports its state."
    return f"The driver is {words}{f' ({why})' if why else ''}."


def list_lines(state: PageState, now: float, namespace: str, said: str) -> dict[str, list[str]]:
    """Return all lines of the page, by place; ``said``: the result of the last press."""
    target, drift, job = "No target since this page was opened.", "Drift: nothing judged yet.", ""
    if (answer := state.answer) is not None:
        why = f": {answer.message}" if answer.message else ""
        sent = "" if answer.sent else ", nothing sent"
        target = f"Last target: {answer.status}{sent}{why}."
    if not math.isnan(state.evidence):
        warns = "warns" if state.evidence >= 1.0 else "does not warn"
        drift = f"Drift: evidence {state.evidence:.2f} of 1; the test {warns}."
    if (progress := state.progress) is not None:
        age_s = now - progress.at
        heard = f"; heard {_format_ago(age_s)} ago" if age_s > 5.0 else ""
        job = f"collect: {progress.message}{heard}"
    lines = {
        "state": [say_headline(state, now, namespace), target],
        "said": [said],
        "job": [job],
        "tip": [
            f"tip − target: {format_mm(state.miss_at_target(now))}",
            f"tip − predicted: {format_mm(state.miss_of_prediction(now))}",
            drift,
            *(f"{what}: {told}." for what, told in state.told.items()),
        ],
        "health": [line for _, n in sorted(state.nodes.items()) for line in describe_health(n, now)]
        or ["no node has reported yet"],
    }
    return {place: [line for line in found if line] for place, found in lines.items()}


def format_mm(vector: np.ndarray | str) -> str:
    """Write the length and components of a vector (3,), m, in mm; a text stays as it is."""
    if isinstance(vector, str):
        return vector
    parts = ", ".join(
        f"{axis} {1e3 * part:+.2f}" for axis, part in zip("xyz", vector.tolist(), strict=True)
    )
    return f"{1e3 * math.dist((0.0, 0.0, 0.0), vector.tolist()):.2f} mm ({parts})"


LEGEND = (
    "Grey: the arm as declared, rigid. Blue: as predicted. Green: target. Yellow: pseudo-target. "
    "Red: tip, and tip − target. Orange: tip − predicted."
)


def describe_scale(deflection: float, error: float) -> str:
    """Say what is drawn larger than it is."""
    bent = "to scale" if deflection == 1.0 else f"{deflection:g} times larger than it is"
    arrows = "to scale" if error == 1.0 else f"{error:g} times longer than they are"
    drawn = f"The blue arm's deflection is drawn {bent}, error arrows {arrows}."
    return f"{drawn} Everything else is to scale."


def describe_health(node: NodeHealth, now: float) -> list[str]:
    """Return a line on a node and one on each ill part, each with the sign of its level."""
    if silent := node.silent_s(now):
        return [f"{SILENT} {node.name}: silent for {_format_ago(silent)}"]
    sign, word = LEVELS[max(part.level for part in node.parts)]
    ill = [part for part in node.parts if part.level]
    return [
        f"{sign} {node.name}: {word}",
        *(f"{LEVELS[part.level][0]} {part.name}: {part.message}" for part in ill),
    ]


def _format_ago(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
