"""Held-out rows and resampled rows, both in whole blocks of successive poses."""

import numpy as np

from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError


def blocked_split(
    session: Session, fraction: float = 0.2, rng: np.random.Generator | int = 0
) -> tuple[Session, Session]:
    """Split a session into training rows and held-out rows, in whole blocks of time.

    Blocks (`blocks_of`) are drawn until `fraction` of the rows and 30 measured poses are held out.
    After the first block, a block that would raise the held-out poses above a third is left out.

    Raises:
        InputError: there are fewer than two poses, or `fraction` is not between 0 and 1.
    """
    if not 0 < fraction < 1:
        raise InputError("split", "fraction", fraction, "between 0 and 1")
    poses = len(np.unique(session.pose_id))
    if poses < 2:
        raise session.error("poses", poses, "at least 2 distinct poses to split")
    block, held = blocks_of(session), np.zeros(len(session), dtype=bool)
    for drawn in np.random.default_rng(rng).permutation(np.unique(block)):
        more = held | (block == drawn)
        if len(np.unique(session.pose_id[more])) > max(1, poses // 3) and held.any():
            continue
        held = more
        seen_poses = len(np.unique(session.pose_id[held & session.seen]))
        if held.sum() >= fraction * len(session) and seen_poses >= 30:
            break
    return session.take(~held), session.take(held)


def mark_copies(rows: Session, fitted: Session) -> np.ndarray:
    """Mark (M,) the rows that repeat joints and measurement of a fitted row to the last digit.

    A position alone tells; other measurements count where there is none.
    """
    further = [kind for kind in KINDS.values() if kind.name != "position"]

    def contents(some: Session) -> list[tuple[object, ...]]:
        placed = some.has_position
        others = np.column_stack([some.reading(kind) for kind in further if kind.cells])
        others[placed] = np.nan
        texts = [np.where(placed, "", some.texts(kind.label)) for kind in further if kind.label]
        numbers = np.column_stack([some.q, some.xyz, others])
        each = (row.tobytes() for row in numbers)
        return list(zip(each, some.texts("marker"), *texts, strict=True))

    known = set(contents(fitted))
    return np.array([each in known for each in contents(rows)], dtype=bool)


FOLDS, MORE_FOLDS = 5, 10
"""Number of folds of a session, and of one with fewer poses than `FEW`, whose fits need more."""
FEW = 100
"""Number of poses below which a session has `MORE_FOLDS` folds."""
BLOCKS = 25
"""Number of blocks of successive poses; most correlated noise stays within one block."""
PLACED_APART = ("group", "marker", "sensor", "anchor")
"""Labels whose values are each placed by the rows that hold them."""
_RUN = 50
"""Rows in a run of `spread_rows`: few in a session, but more than its noise is correlated."""


def spread_rows(session: Session, most: int) -> np.ndarray:
    """Mark (N,) at most `most` rows: runs of `_RUN` rows, evenly over the session.

    Added to these is a run of each value of the labels in `PLACED_APART` that none of them holds.
    """
    if len(session) <= most:
        return np.ones(len(session), dtype=bool)
    starts = np.linspace(0, len(session) - _RUN, max(most // _RUN, 1)).round().astype(int)
    taken = np.zeros(len(session), dtype=bool)
    taken[starts[:, None] + np.arange(_RUN)] = True
    for label in set(PLACED_APART) & set(session.labels):
        values = session.labels[label]
        for value in np.setdiff1d(values, values[taken]):
            taken[np.flatnonzero(values == value)[:_RUN]] = True
    return taken


def blocks_of(session: Session) -> np.ndarray:
    """Return for each row (N,) the number of its block; all visits to a pose are in one block."""
    _, first, inverse = np.unique(session.pose_id, return_index=True, return_inverse=True)
    poses = len(first)
    place = np.empty(poses, dtype=np.int64)
    place[np.argsort(first)] = np.arange(poses)
    return np.asarray((place * min(BLOCKS, poses) // poses)[inverse])


def folds_of(session: Session, rng: np.random.Generator | int = 0) -> np.ndarray:
    """Return for each row (N,) the number of the fold in which it is held out, by whole blocks.

    It is -1 for a row that is in every fit, because no other fold shows where its marker, sensor,
    anchor or base is.

    Raises:
        InputError: no row can be held out.
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
    """Draw bootstrap samples of whole blocks: how often each row occurs in each, (count, N)."""
    names, inverse = np.unique(blocks_of(session), return_inverse=True)
    share = np.full(len(names), 1.0 / len(names))
    drawn = np.random.default_rng(rng).multinomial(len(names), share, size=count)
    return np.asarray(drawn[:, inverse])


def split_in_half(session: Session, rng: np.random.Generator | int = 0) -> tuple[np.ndarray, ...]:
    """Return the masks (N,) of two random halves of the rows, split by whole poses."""
    poses = np.unique(session.pose_id)
    drawn = np.random.default_rng(rng).permutation(poses)[: len(poses) // 2]
    first = np.isin(session.pose_id, drawn)
    return first, ~first
