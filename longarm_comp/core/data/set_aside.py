"""Rows that a fit sets aside: gross errors are isolated and share nothing; else look for a cause.

Every input is searched for a value or range that these rows share.  For texts, and for joints that
mostly stand still, the p-value is that of so many rows at one value (Fisher's exact test).  For
other numbers it is that of so many rows so close together: the densest interval that begins and
ends at one of them, its two ends not counted.  Rows of one visit to a pose count as one, because
one disturbance spoils them all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import ORDER
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.units import describe_range
from longarm_comp.core.yaml_file import Closed

SIGNIFICANT = 1e-3
"""p-value, over all inputs, below which rows have a trait in common.

Of a thousand sessions with isolated gross errors, one is wrongly suspected.
"""
RESTING = 0.5
"""Fraction of the visits at one value from which on a joint counts as mostly standing still."""
EITHER = 0.5
"""Probability that the arm, not the sensor, caused a row set aside of which nothing is known."""
FEW = 3
"""Smallest number of visits that can have a trait in common."""


class SharedBy(Closed):
    """A common trait of rows set aside; report.json holds it so."""

    input: str  # column of the session, or ``order`` (the row's place in the file)
    value: str  # the common value or range of this input, in words
    rows: int  # the number of rows set aside that have it
    p_value: float  # of this many by chance, times the number of inputs that were tried

    def __str__(self) -> str:
        return f"{self.input} {self.value} ({self.rows} of them, p {self.p_value:.1g})"


@dataclass(frozen=True)
class SetAside:
    """Rows of a session that a fit does not believe."""

    rows: tuple[int, ...]  # their positions among the rows that were fitted
    share: float  # their fraction of these
    shared_by: tuple[SharedBy, ...]  # the traits that they have in common, the least probable first

    @classmethod
    def of(cls, session: Session, aside: np.ndarray) -> SetAside:
        """Make it from the rows that were fitted and a mask (N,) of those set aside."""
        tried = [(name, each) for name, each in _try_inputs(session, aside) if each is not None]
        found = [
            SharedBy(input=name, value=value, rows=rows, p_value=min(p * len(tried), 1.0))
            for name, (value, rows, p) in tried
            if p * len(tried) < SIGNIFICANT
        ]
        places = tuple(np.flatnonzero(aside).tolist())
        share = float(aside.mean()) if len(aside) else 0.0
        return cls(places, share, tuple(sorted(found, key=lambda s: s.p_value)))

    @property
    def record(self) -> dict[str, object]:
        """The entry of report.json: their number, their fraction, and the traits in common."""
        shared = [each.model_dump() for each in self.shared_by]
        return {"rows": len(self.rows), "share": self.share, "shared_by": shared}

    @property
    def summary(self) -> str:
        """A text with the number of rows set aside and the traits that they have in common."""
        shared = " and ".join(map(str, self.shared_by[:2]))
        text = f"{len(self.rows)} rows set aside ({self.share:.1%})"
        return f"{text}, which share {shared}" if shared else text

    def describe(self, session: Session) -> str:
        """Return the summary and a list of the rows, each by its label `point` or by its index."""
        numbers = session.labels.get("point", session.index)[list(self.rows)]
        return f"{self.summary}: {', '.join(map(str, numbers))}" if self.rows else self.summary


def chance_of_arm(session: Session, aside: np.ndarray) -> np.ndarray:
    """Return for each row the probability (N,) that the arm was where a row set aside says.

    It is 0 where another row of the visit, from the same sides, is believed: the arm stood there.
    Else it is `EITHER`, or the fraction of the rows that share a trait, if that is more.

    Args:
        aside: (N,) bool, the rows set aside.
    """
    visit = np.cumsum(np.r_[0, np.diff(session.pose_id) != 0])
    stood = np.column_stack([visit, session.approach])
    _, which = np.unique(stood, axis=0, return_inverse=True)
    believed = np.bincount(which.reshape(-1), weights=~aside)[which.reshape(-1)] > 0
    shared = max((each.rows for each in SetAside.of(session, aside).shared_by), default=0)
    return np.where(believed, 0.0, max(EITHER, shared / max(int(aside.sum()), 1)))


_Found = tuple[str, int, float]


def _try_inputs(session: Session, aside: np.ndarray) -> Iterator[tuple[str, _Found | None]]:
    """Yield every input, and the most significant trait of the rows set aside in it.

    A trait is a value in words, the number of rows that have it, and its p-value.
    """
    visit = np.cumsum(np.r_[0, np.diff(session.pose_id) != 0])
    first = np.unique(visit, return_index=True)[1]
    spoilt = np.maximum.reduceat(aside.astype(int), first) > 0
    rows = np.add.reduceat(aside.astype(int), first)
    for j, values in enumerate(session.q[first].T, 1):
        levels, which, count = np.unique(values, return_inverse=True, return_counts=True)
        rest = int(np.argmax(count))
        if count[rest] >= RESTING * len(values):
            stands = f"{levels[rest]:.4g}"
            texts = np.where(which == rest, f"at {stands}", f"other than {stands}")
            yield f"q{j}", _commonest_text(texts, spoilt, rows)
        yield f"q{j}", _densest_stretch(values, spoilt, rows)
    for j, sides in enumerate(session.approach[first].T, 1):
        texts = np.array(["unknown", "+1", "-1"])[np.sign(sides).astype(int)]
        yield f"approach of q{j}", _commonest_text(texts, spoilt, rows)
    yield "order", _densest_stretch(first + 1.0, spoilt, rows)
    for name, values in session.columns.items():
        if name != ORDER:  # as tried
            yield name, _densest_stretch(values[first], spoilt, rows)
    for name, texts in session.labels.items():
        constant = (texts == texts[first][visit]).all()
        once = (texts[first], spoilt, rows) if constant else (texts, aside, aside.astype(int))
        yield name, _commonest_text(*once)
    where = np.isfinite(session.xyz).all(axis=1)
    for name, values in zip("xyz", session.xyz[where].T, strict=True):
        yield name, _densest_stretch(values, aside[where], aside[where].astype(int))


def _commonest_text(texts: np.ndarray, spoilt: np.ndarray, rows: np.ndarray) -> _Found | None:
    """Return the text that is most significant for the visits set aside, with rows and p-value.

    None if all texts are the same, or fewer than `FEW` visits are set aside.  `spoilt` says of
    each visit whether any row of it is set aside, and `rows` how many are.
    """
    names = np.unique(texts)
    if len(names) < 2 or spoilt.sum() < FEW:
        return None
    from scipy.stats import hypergeom  # takes a quarter of a second

    chances = []
    for name in names:
        mine = texts == name
        both = int((mine & spoilt).sum())
        p = float(hypergeom.sf(both - 1, len(texts), spoilt.sum(), mine.sum()))
        chances.append((p * len(names), str(name), int(rows[mine].sum())))
    p, value, count = min(chances)
    return value, count, p


def _densest_stretch(values: np.ndarray, spoilt: np.ndarray, rows: np.ndarray) -> _Found | None:
    """Return the interval of a number in which the visits set aside are most significantly dense.

    Arguments and result are those of `_commonest_text`, with numbers instead of texts.
    """
    order = np.argsort(values, kind="stable")
    values, spoilt, rows = values[order], spoilt[order], rows[order]
    at = values[spoilt]
    k, n = len(at), len(values)
    if k < FEW or values[0] == values[-1]:
        return None
    from scipy.stats import hypergeom  # takes a quarter of a second

    low, high = np.searchsorted(values, at, "left"), np.searchsorted(values, at, "right")
    begin, end = np.triu_indices(k, FEW - 1)
    span = high[end] - low[begin]
    inside = np.searchsorted(at, at[end], "right") - np.searchsorted(at, at[begin], "left")
    chance = hypergeom.sf(inside - 3, n - 2, k - 2, span - 2) * len(begin)
    best = int(np.argmin(chance))
    a, b = at[begin[best]], at[end[best]]
    count = int(rows[(values >= a) & (values <= b)].sum())
    return describe_range(a, b), count, float(chance[best])
