"""One row of results: what was measured, beside what, and how far the repeats differ."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Result = dict[str, object]


def beside(
    name: str,
    unit: str,
    ours: Sequence[float] | np.ndarray,
    peer: str,
    theirs: Sequence[float] | np.ndarray,
    *,
    more_is_better: bool = False,
    **further: object,
) -> Result:
    """Medians of repeats that took turns; the ratio is above 1 where this package is ahead.

    Args:
        name: of the benchmark.
        unit: of both sides.
        ours, theirs: one figure per repeat; a single one of a side stands for all.
        peer: what it is compared with.
        more_is_better: a rate; otherwise a time or a size.
        further: other figures and a note.
    """
    mine, other = np.asarray(ours, float), np.asarray(theirs, float)
    each = mine / other if more_is_better else other / mine
    return {
        "name": name,
        "value": float(np.median(mine)),
        "unit": unit,
        "peer": peer,
        "peer_value": float(np.median(other)),
        "ratio": float(np.median(each)),
        "spread": [float(each.min()), float(each.max())],
        **further,
    }


def alone(
    name: str, unit: str, ours: Sequence[float] | np.ndarray, note: str, **further: object
) -> Result:
    """A figure that nothing is compared with; the spread is of the figure itself."""
    mine = np.asarray(ours, float)
    return {
        "name": name,
        "value": float(np.median(mine)),
        "unit": unit,
        "peer": None,
        "peer_value": None,
        "ratio": None,
        "spread": [float(mine.min()), float(mine.max())],
        "note": note,
        **further,
    }


def missing(name: str, peer: str, why: str) -> Result:
    """A benchmark whose peer cannot be had here."""
    empty = dict.fromkeys(("value", "unit", "peer_value", "ratio", "spread"))
    return {"name": name, "peer": peer, "note": why, **empty}
