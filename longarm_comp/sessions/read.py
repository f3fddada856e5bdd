"""Reads a session, or the free vibration after a move (a ring), from any supported format."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.csv import read_csv, read_touches
from longarm_comp.sessions.table import read_table


def read_session(path: str | Path, arm: Arm) -> Session:
    """Read a CSV file, or a rosbag2: its folder or a ``.mcap`` or ``.db3`` file.

    ``touches.yaml`` beside it holds known distances between the points that it touches.

    Raises:
        InputError: the file cannot be read in the format that its name says.
    """
    path = Path(path)
    touch_distances = read_touches(path)
    if not _is_bag(path):
        return read_csv(path, arm, touch_distances)
    from longarm_comp.sessions.bag import read_bag  # a CSV needs none of its libraries

    return read_bag(path, arm, touch_distances=touch_distances)


def _is_bag(path: Path) -> bool:
    return path.is_dir() or path.suffix in (".mcap", ".db3")


@dataclass(frozen=True, eq=False)
class _RecordedRing:
    """A free vibration after a move."""

    times: np.ndarray  # (N,) s
    seen: np.ndarray  # tip (N, 3), m, or joints (N, n), rad and m, at these times
    of_joints: bool
    at: np.ndarray | None = None  # (n,) joints that were commanded; None: the file does not say


def read_ring(path: str | Path, arm: Arm) -> _RecordedRing:
    """Read the free vibration after a move from a CSV or a bag.

    A CSV has t_s and the joint readings read_q1..qn (rad or m) or, without these, x, y, z of the
    tip (m); rows with a blank are left out. A bag is read from when the joints stand still after
    its last command. If it has fewer than `LEAST` sightings of the tip from then on, the joint
    readings are returned instead. Raises InputError if the file is damaged or lacks what is read.
    """
    path = Path(path)
    if not _is_bag(path):
        table = read_table(path)
        readings = [f"read_q{joint}" for joint in range(1, arm.n + 1)]
        of_joints = table.has(readings)
        names = readings if of_joints else list("xyz")
        (times,) = table.block(("t_s",), "s").T
        seen = table.block(names, "rad or m" if of_joints else "m", True)
        kept = np.isfinite(seen).all(axis=1)
        return _RecordedRing(times[kept], seen[kept], of_joints)
    from longarm_comp.core.data.rest import still_since
    from longarm_comp.core.vibration.seen import LEAST
    from longarm_comp.sessions.bag import read_last
    from longarm_comp.sessions.message_buffer import between

    buffer = read_last(path, arm)
    begin, points = buffer.commands[0]
    times, joints = buffer.states_between(begin, np.inf)
    if not len(times):
        allowed = "what tells when the joints stand after the last command"
        raise InputError(str(path), "joint_states", "no message", allowed)
    since = still_since(times, joints, begin)
    tips = [s for s in between(buffer.sightings, since, np.inf) if np.isfinite(s.xyz).all()]
    if len(tips) >= LEAST:
        at, xyz = np.array([s.t for s in tips]), np.array([s.xyz for s in tips])
        return _RecordedRing(at, xyz, False, points[-1])
    stands = times > since
    return _RecordedRing(times[stands], joints[stands], True, points[-1])
