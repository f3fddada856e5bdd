"""Rows held out, and rows drawn again, by whole blocks of successive poses."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError


def blocked_split(
    session: Session, fraction: float = 0.2, rng: np.random.Generator | int = 0
) -> tuple[Session, Session]:
    """Split a session into training set and hold-out in whole blocks of time.

    The poses are divided into about 25 blocks, each pose with all of its visits. Blocks are drawn
    until the hold-out has `fraction` of the rows and 30 poses with a marker, but never more than a
    third of the poses.
    """
    if not 0 < fraction < 1:
        raise InputError("split", "fraction", fraction, "between 0 and 1")
    poses = len(np.unique(session.pose_id))
    if poses < 2:
        raise session.error("poses", poses, "at least 2 distinct poses to split")
    block = blocks_of(session)
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
"""Rows in a run of `take_spread_rows`: short beside a session, long beside its noise's memory."""


def take_spread_rows(session: Session, most: int) -> Session:
    """Take at most so many rows: runs of neighbours, evenly over the session."""
    runs = most // _RUN
    if len(session) <= most:
        return session
    starts = np.linspace(0, len(session) - _RUN, runs).round().astype(int)
    return session.take(np.unique(starts[:, None] + np.arange(_RUN)))


FOLDS, MORE_FOLDS = 5, 10
"""Folds of a session, and of one with fewer poses than `FEW`, whose fits need most of them."""
FEW = 100
"""Poses below which a fold takes a tenth of them."""
BLOCKS = 25
"""Blocks of successive poses; noise that lasts for a while stays within one."""
PLACED_APART = ("group", "marker", "sensor", "anchor")
"""Labels whose placement is solved from their own rows."""


def blocks_of(session: Session) -> np.ndarray:
    """Return the number (N,) of the block of successive poses that each row is in, whole poses."""
    _, first, inverse = np.unique(session.pose_id, return_index=True, return_inverse=True)
    poses = len(first)
    place = np.empty(poses, dtype=np.int64)
    place[np.argsort(first)] = np.arange(poses)
    return np.asarray((place * min(BLOCKS, poses) // poses)[inverse])


def folds_of(session: Session, rng: np.random.Generator | int = 0) -> np.ndarray:
    """Return (N,) number of the fold in which each row is held out, by whole blocks.

    -1 of a row that is in every fit: the other folds do not tell where its marker, sensor or base
    is.

    Raises:
        InputError: there is no row that can be held out.
    """
    block = blocks_of(session)
    names = np.unique(block)
    count = min(FOLDS if len(np.unique(session.pose_id)) >= FEW else MORE_FOLDS, len(names))
    drawn = np.random.default_rng(rng).permutation(len(names)) % count
    fold = drawn[np.searchsorted(names, block)]
    for label in set(PLACED_APART) & set(session.labels):
        for value in np.unique(session.labels[label]):
            mine = session.labels[label] == value
            if len(np.unique(fold[mine])) == 1:
                fold = np.where(mine, -1, fold)
    if (fold < 0).all():
        labels = ", ".join(label for label in PLACED_APART if label in session.labels)
        raise session.error(labels, "each in few rows", "one of them, at least, in many poses")
    return np.asarray(fold)


def draw_row_counts(session: Session, count: int, rng: np.random.Generator | int = 0) -> np.ndarray:
    """Draw (count, N) how often each row counts where whole blocks are drawn with replacement."""
    block = blocks_of(session)
    names, inverse = np.unique(block, return_inverse=True)
    share = np.full(len(names), 1.0 / len(names))
    drawn = np.random.default_rng(rng).multinomial(len(names), share, size=count)
    return np.asarray(drawn[:, inverse])


def split_in_half(session: Session, rng: np.random.Generator | int = 0) -> tuple[np.ndarray, ...]:
    """Return (N,) masks of two random halves of the rows; rows of one pose stay together."""
    rng = np.random.default_rng(rng)
    poses = np.unique(session.pose_id)
    drawn = rng.permutation(poses)[: len(poses) // 2]
    first = np.isin(session.pose_id, drawn)
    return first, ~first
