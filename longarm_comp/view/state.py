"""What the graph has said last, as one frozen record. Times are of a monotonic clock, s."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from longarm_comp.core.data.rest import JOINT_REST

_SILENT_S = 3.0
"""Joints come many times a second: after so long without any message the graph is silent."""


@dataclass(frozen=True, eq=False)
class Picture:
    """The arm as `markers` shows it: polylines (k, 3) m from foot to tip, base frame.

    `hanging`: by the model in use, true to scale. `target`, `pseudo_target`: (3,), of the last one.
    """

    declared: np.ndarray
    hanging: np.ndarray
    target: np.ndarray | None
    pseudo_target: np.ndarray | None
    at: float


@dataclass(frozen=True, eq=False)
class SeenTip:
    """The tip as the cameras see it, (3,) m; NaN where the marker is lost."""

    xyz: np.ndarray
    at: float


@dataclass(frozen=True)
class LastAnswer:
    """What became of the last target: status, reason, joints sent by name (none: not sent)."""

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
    """What a node reports, and when it did so last."""

    name: str
    parts: tuple[Part, ...]
    at: float
    every_s: float = 0.0

    def silent_s(self, now: float) -> float:
        """For how long it has said nothing that it should have said; 0: it speaks."""
        return _silence(self.at, now, max(5.0, 3.0 * self.every_s))


@dataclass(frozen=True)
class CollectProgress:
    """How far a collection is: share of its plan, 0 to 1, and words."""

    share: float
    message: str
    at: float


@dataclass(frozen=True, eq=False)
class PageState:
    """Everything that the page shows.

    Attributes:
        heard: when any message came last; None before the first.
        joints: last reading by name, rad and m.
        read: when the joints were read last; None before the first.
        moved: when a joint moved last by more than `JOINT_REST`.
        driver: state of the driver in a word, and its reason; empty before the first.
        evidence: of drift, share of what warns; NaN where nothing judges.
        told: in words, by what it is of: what was learned at work, the ring after the last move.
        seed: reading that later ones are compared with for `moved`.
    """

    heard: float | None = None
    picture: Picture | None = None
    tip: SeenTip | None = None
    joints: Mapping[str, float] = field(default_factory=dict)
    read: float | None = None
    moved: float = -math.inf
    driver: tuple[str, str] = ("", "")
    answer: LastAnswer | None = None
    nodes: Mapping[str, NodeHealth] = field(default_factory=dict)
    progress: CollectProgress | None = None
    evidence: float = math.nan
    told: Mapping[str, str] = field(default_factory=dict)
    seed: Mapping[str, float] = field(default_factory=dict)

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
        """For how long the whole graph has said nothing; 0: it speaks; infinite: never."""
        return _silence(self.heard, now, _SILENT_S)

    def unread_s(self, now: float) -> float:
        """For how long no joints have come; as `silent_s`."""
        return _silence(self.read, now, _SILENT_S)

    def old(self, now: float) -> bool:
        """Whether the picture of the arm is not of now."""
        at = None if self.picture is None else self.picture.at
        return bool(self.unread_s(now) or _silence(at, now, 5.0))

    def seen_tip(self, now: float) -> np.ndarray | None:
        """(3,) m where the tip is seen now; None where it is not."""
        if self.tip is None or now - self.tip.at >= 3.0 or np.isnan(self.tip.xyz).any():
            return None
        return self.tip.xyz

    @property
    def resting(self) -> bool:
        """Whether picture and sighting are both of the arm at rest."""
        # A picture is a half second old and a sighting some frames: what came later after the last
        # movement is of the arm at rest
        since = self.moved + 0.6
        both = self.picture is not None and self.tip is not None
        return both and min(self.picture.at, self.tip.at) > since  # type: ignore[union-attr]

    @property
    def at_target(self) -> bool:
        """Whether the joints stand where the last target sent them."""
        return self.answer is not None and _same_joints(self.answer.sent, self.joints)

    def missed(self, now: float) -> np.ndarray | None:
        """tip - target (3,) m, where the arm rests at its target and is seen."""
        tip, picture = self.seen_tip(now), self.picture
        if tip is None or picture is None or picture.target is None:
            return None
        return tip - picture.target if self.resting and self.at_target else None

    def unpredicted(self, now: float) -> np.ndarray | None:
        """tip - predicted tip (3,) m, where the arm rests and is seen."""
        tip, picture = self.seen_tip(now), self.picture
        if tip is None or picture is None or not self.resting:
            return None
        return tip - picture.hanging[-1]


def _silence(last: float | None, now: float, allowed: float) -> float:
    """Time since ``last`` where it is longer than allowed, else 0."""
    quiet = math.inf if last is None else now - last
    return quiet if quiet > allowed else 0.0


def _same_joints(sent: Mapping[str, float], joints: Mapping[str, float]) -> bool:
    """Whether there are joints and all of them stand there, within `JOINT_REST`."""
    return bool(sent) and all(
        name in joints and abs(joints[name] - value) <= JOINT_REST for name, value in sent.items()
    )
