"""The report of a trajectory follower: its state, events, accepted trajectories, steps."""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from longarm_comp.devices.servo_watch import JointFault


class FollowerState(Enum):
    IDLE = "idle"
    TRACKING = "tracking"
    HOLDING = "holding"
    FAULT = "fault"
    ESTOP = "estop"


class EventKind(Enum):
    STARTED = "started"
    REPLACED = "replaced"
    SLOWED = "slowed"
    ARRIVED = "arrived"
    SHORT = "short of its end"
    DOUBTFUL = "doubtful"
    FAULT = "fault"
    ESTOP = "estop"
    RESET = "reset"
    HELD = "held"


@dataclass(frozen=True)
class Event:
    """One event to report to the user. ``finding`` is set only for FAULT."""

    kind: EventKind
    message: str
    finding: JointFault | None = None


@dataclass(frozen=True, eq=False)
class Accepted:
    """An accepted trajectory, as it will be followed."""

    start: np.ndarray
    """(n,) set-point from which it starts, in the order of the configuration (rad, m)."""
    points: np.ndarray  # (k, n) way-points of all joints, rad and m
    times: np.ndarray  # (k,) s, from now on, at which the way-points are passed
    replaces: bool  # whether it replaces a trajectory that is still being followed


@dataclass(frozen=True)
class Step:
    state: FollowerState  # after the step
    goals: dict[int, int] | None  # ticks by servo id to send now; None: send nothing
    set_points: dict[str, float]
    """Commanded joint values, rad or m; empty when nothing is commanded."""
    events: tuple[Event, ...]  # in the order in which they happened
