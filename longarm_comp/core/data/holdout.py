"""Hold-outs: split by whole blocks and whole poses, sealed until the fit is finished."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, LongarmError


def blocked_split(
    session: Session, fraction: float = 0.2, rng: np.random.Generator | int = 0
) -> tuple[Session, Session]:
    """Training set and hold-out in whole blocks of time.

    The poses are divided into about 25 blocks, each pose with all of its visits. Blocks are drawn
    until the hold-out has `fraction` of the rows and 30 poses with a marker, but never more than a
    third of the poses.
    """
    if not 0 < fraction < 1:
        raise InputError("split", "fraction", fraction, "between 0 and 1")
    _, first, inverse = np.unique(session.pose_id, return_index=True, return_inverse=True)
    poses = len(first)
    if poses < 2:
        raise InputError(session.source, "poses", poses, "at least 2 distinct poses to split")
    place = np.empty(poses, dtype=np.int64)
    place[np.argsort(first)] = np.arange(poses)
    block = (place * min(25, poses) // poses)[inverse]
    held = np.zeros(len(session), dtype=bool)
    for drawn in np.random.default_rng(rng).permutation(np.unique(block)):
        more = held | (block == drawn)
        if len(np.unique(session.pose_id[more])) > max(1, poses // 3) and held.any():
            continue
        held = more
        seen_poses = len(np.unique(session.pose_id[held & session.seen]))
        if held.sum() >= fraction * len(session) and seen_poses >= 30:
            break
    return session.take(~held), session.take(held)


_RUN = 50
"""Rows in a run of `spread`: short beside a session, long beside the memory of its noise."""


def spread(session: Session, most: int) -> Session:
    """At most so many rows: runs of neighbours, evenly over the session; all where they are few."""
    runs = most // _RUN
    if len(session) <= most:
        return session
    starts = np.linspace(0, len(session) - _RUN, runs).round().astype(int)
    return session.take(np.unique(starts[:, None] + np.arange(_RUN)))


class SealedError(LongarmError):
    """A hold-out was read before the fit that it tests was finished."""


class Sealed:
    """A hold-out that cannot be read until `release`.

    `open(reason)` returns it and is counted, since a hold-out that was used often proves little.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._finished = ""
        self._uses: list[str] = []

    @property
    def uses(self) -> tuple[str, ...]:
        """Reasons for which it was opened, in order."""
        return tuple(self._uses)

    def release(self, finished: str) -> None:
        """Allow `open`, given the hash of the finished model that is to be tested."""
        self._finished = finished

    def open(self, reason: str) -> Session:
        """The rows. Raises `SealedError` before `release`."""
        if not self._finished:
            raise SealedError(f"the held-out rows may be read once the fit is finished: {reason}")
        self._uses.append(reason)
        return self._session
