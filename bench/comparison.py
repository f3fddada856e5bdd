"""One row of results, without its name: value, peer, ratio and spread of the repeats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Result = dict[str, object]


def beside(
    unit: str,
    ours: Sequence[float] | np.ndarray,
    peer: str,
    theirs: Sequence[float] | np.ndarray,
    *,
    more_is_better: bool = False,
    **further: object,
) -> Result:
    """Medians of alternating repeats. The ratio is above 1 if this package is better.

    Args:
        unit: of both sides.
        ours, theirs: one value per repeat; a single value stands for all repeats.
        peer: name of the peer.
        more_is_better: True for a rate, False for a time or a size.
        further: other figures and a note.
    """
    mine, other = np.asarray(ours, float), np.asarray(theirs, float)
    each = mine / other if more_is_better else other / mine
    return {
        "value": float(np.median(mine)),
        "unit": unit,
        "peer": peer,
        "peer_value": float(np.median(other)),
        "ratio": float(np.median(each)),
        "spread": [float(each.min()), float(each.max())],
        **further,
    }


def alone(unit: str, ours: Sequence[float] | np.ndarray, note: str, **further: object) -> Result:
    """A value without a peer; the spread is of the value itself."""
    mine = np.asarray(ours, float)
    return {
        "value": float(np.median(mine)),
        "unit": unit,
        "peer": None,
        "peer_value": None,
        "ratio": None,
        "spread": [float(mine.min()), float(mine.max())],
        "note": note,
        **further,
    }


def missing(peer: str, why: str) -> Result:
    """A benchmark whose peer is not available here."""
    empty = dict.fromkeys(("value", "unit", "peer_value", "ratio", "spread"))
    return {"peer": peer, "note": why, **empty}
