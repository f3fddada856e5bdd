"""What one step of the trajectory follower says: goals to send, and what happened."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from longarm_comp.devices.servo_watch import Finding


class FollowerState(Enum):
    """What the follower is doing."""

    IDLE = "idle"
    TRACKING = "tracking"
    HOLDING = "holding"
    FAULT = "fault"
    ESTOP = "estop"


class EventKind(Enum):
    """What happened in a step, or since the last one."""

    STARTED = "started"
    REPLACED = "replaced"
    SLOWED = "slowed"
    ARRIVED = "arrived"
    DOUBTFUL = "doubtful"
    FAULT = "fault"
    ESTOP = "estop"
    RESET = "reset"


@dataclass(frozen=True)
class Event:
    """One thing worth telling the user; ``finding`` only with FAULT."""

    kind: EventKind
    message: str
    finding: Finding | None = None


@dataclass(frozen=True)
class Step:
    """The outcome of one step.

    Attributes:
        state: after the step.
        goals: ticks by servo id to send now; None: send nothing.
        set_points: commanded joint values, rad or m; empty when nothing is commanded.
        events: in the order in which they happened.
    """

    state: FollowerState
    goals: dict[int, int] | None
    set_points: dict[str, float]
    events: tuple[Event, ...]
