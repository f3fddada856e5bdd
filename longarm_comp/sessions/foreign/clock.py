"""Times of other programs: seconds in any unit, dates and times of day, 20200714163904."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

_STAMP = re.compile(r"(19|20)\d{12}(\.0*)?")
_PLAIN = re.compile(r"[-+]?[\d.,]+([eE][-+]?\d+)?")
_OF_DAY = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?")


def seconds(texts: Sequence[str]) -> np.ndarray | None:
    """(N,) seconds since the first of wall-clock times; None where a text is not one."""
    import pandas as pd

    texts = [text.strip() for text in texts]
    try:
        if all(map(_STAMP.fullmatch, texts)):
            when = pd.to_datetime(pd.Series([t[:14] for t in texts]), format="%Y%m%d%H%M%S")
        elif any(map(_PLAIN.fullmatch, texts)):
            return None
        elif all(map(_OF_DAY.fullmatch, texts)):
            whole = [f"{t}:00" if t.count(":") == 1 else t.replace(",", ".") for t in texts]
            passed = pd.to_timedelta(pd.Series(whole)).dt.total_seconds().to_numpy()
            days = np.cumsum(np.diff(passed, prepend=passed[:1]) < -12 * 3600)  # past midnight
            return np.asarray(passed - passed[0] + 86400.0 * days)
        else:
            when = pd.to_datetime(pd.Series(texts), format="mixed", utc=True)
    except (ValueError, OverflowError):
        return None
    if when.isna().any():
        return None
    return (when - when.iloc[0]).dt.total_seconds().to_numpy()
