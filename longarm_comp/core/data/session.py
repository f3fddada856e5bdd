"""A session: commanded joints, measured tips and their circumstances.

Values that depend on the order of recording, such as how a joint arrived, are derived once when the
session is made.  So any subset of its rows may be taken afterwards.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

from longarm_comp.core.arm.context import INCLINATION, LEGS, Context
from longarm_comp.core.arm.history import (
    SAME_POSE,
    History,
    first_of_stand,
    list_wrong_run_ups,
    read_sides,
    recorded_history,
    straight_ways,
)
from longarm_comp.core.arm.measuring import KnownDistance
from longarm_comp.core.data.measured_rows import ChannelBlock, MeasuredRows, array_of, freeze
from longarm_comp.core.errors import InputError
from longarm_comp.core.html_table import html_table

_Rows = np.ndarray | Sequence[int] | slice
_BY_NAME = ("columns", "labels", "readings", "sigmas")


@dataclass(frozen=True, eq=False)
class Session(MeasuredRows):
    """N measurements of an arm with n commanded joints. Arrays are read-only.

    Attributes:
        index: (N,) counter of the recording. A step other than 0 or 1 is a gap.
        q: (N, n) commanded joints, rad and m.
        xyz: (N, 3) measured tip, m. NaN is a coordinate that was not measured.
        approach: (N, n) side each joint arrived from: +1 from below, -1 from above, 0 unknown.
        repeat_id: (N,) rows with the same number revisit one pose; -1 for none.
        sigma: (N, 3) standard deviation of the measurement in m, or None.
        columns: further numbers by name, (N,) each, finite: `t_s`, `temperature_c`,
            `payload_kg`, `incl_<frame>_x`, any other quantity that was recorded.
        labels: text by name, (N,) each: `group`, `marker`, `role`, any other.
        source: file or bag from which it was read, for messages.
        legs, last_way: (N, n, LEGS) and (N, n) rad and m, as in a `Context`.
        told: (N, n) side (+-1) of joints of which only the side of arrival was recorded, with a
            run-up of unknown length; 0 for others.
        readings: further measurements by kind (`core/data/kinds.py`), (N, c) each; NaN in rows
            without one. `orientation`: x, y, z, w; `distance`: m, to the row's `anchor`.
        sigmas: standard deviations of the readings, by kind, (N,) each in m or rad.
        touch_distances: known distances between touched points (`core/data/touched.py`).
        blocks: the channels of the equations; a part of a session keeps those of the whole.
        begun_s: the value of `t_s` from which effects count the time; a machine's clock may count
            from 1970.
        lost: known reasons why rows of the recording hold no measurement, by index; a part of a
            session keeps those of the whole.
    """

    index: np.ndarray
    q: np.ndarray
    xyz: np.ndarray
    approach: np.ndarray
    repeat_id: np.ndarray
    sigma: np.ndarray | None = None
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)
    source: str = "session"
    legs: np.ndarray = field(default_factory=lambda: np.zeros(0))
    last_way: np.ndarray = field(default_factory=lambda: np.zeros(0))
    told: np.ndarray = field(default_factory=lambda: np.zeros(0))
    readings: Mapping[str, np.ndarray] = field(default_factory=dict)
    sigmas: Mapping[str, np.ndarray] = field(default_factory=dict)
    touch_distances: tuple[KnownDistance, ...] = ()
    blocks: tuple[ChannelBlock, ...] = ()
    lost: Mapping[int, str] = field(default_factory=dict)
    begun_s: float = 0.0

    def __post_init__(self) -> None:
        n_rows, n = _joints(self.source, self.q).shape
        if np.isinf(array_of(self.source, "xyz", self.xyz)).any():
            raise self.error("xyz", "not finite", "numbers in m, or NaN")
        shapes: dict[str, tuple[type, tuple[int, ...]]] = {
            "index": (np.int64, (n_rows,)),
            "q": (float, (n_rows, n)),
            "xyz": (float, (n_rows, 3)),
            "approach": (np.int8, (n_rows, n)),
            "legs": (float, (n_rows, n, LEGS)),
            "last_way": (float, (n_rows, n)),
            "told": (np.int8, (n_rows, n)),
            "repeat_id": (np.int64, (n_rows,)),
            "sigma": (float, (n_rows, 3)),
        }
        for name, (kind, shape) in shapes.items():
            values = getattr(self, name)
            if name in ("legs", "last_way", "told") and not len(values):
                values = np.zeros(shape)  # unknown
            if values is not None or name != "sigma":
                object.__setattr__(self, name, freeze(self.source, name, values, kind, shape))
        for field_name, kind in (("columns", float), ("labels", str)):
            given = getattr(self, field_name).items()
            made = {k: freeze(self.source, k, v, kind, (n_rows,)) for k, v in given}
            object.__setattr__(self, field_name, made)
        if self.sigma is not None and (self.sigma <= 0).any():
            raise self.error("sigma", f"{self.sigma.min():g} m", "above 0, or NaN")
        for name, values in self.columns.items():
            if np.isinf(values).any() or (np.isnan(values).any() and not INCLINATION.match(name)):
                raise self.error(name, "not finite", "a finite number in every row")
        self._check_readings(n_rows)
        if not self.blocks:
            object.__setattr__(self, "blocks", self._blocks())

    @classmethod
    def record(
        cls,
        q: np.ndarray,
        xyz: np.ndarray,
        *,
        index: np.ndarray | None = None,
        approach: np.ndarray | None = None,
        run_up: np.ndarray | None = None,
        repeat_id: np.ndarray | None = None,
        source: str = "session",
        touch_distances: Sequence[KnownDistance] = (),
        **further: Any,
    ) -> Session:
        """Make a session from rows in the order of recording, and derive the joints' history.

        Args:
            q: (N, n) commanded joints, rad and m.
            xyz: (N, 3) measured tip, m; NaN where it was not measured.
            index: (N,) counter of the recording; 0, 1, ... by default.
            approach: recorded side of arrival, (N,) for all joints or (N, n); 0 or NaN, which
                is the default, means straight from the row before.
            run_up: (N, n) where each joint's last approach began, rad and m; NaN where there was
                none or this is not known.
            further: other attributes of a session; those that are None are ignored.

        Raises:
            InputError: an array has another shape or kind, or a run-up began on the other side than
                the recorded one.
        """
        q = _joints(source, q)
        index = np.arange(len(q)) if index is None else index
        index = freeze(source, "index", index, np.int64, q.shape[:1])
        repeat_id = np.full(len(q), -1) if repeat_id is None else repeat_id
        begun = np.full(q.shape, np.nan) if run_up is None else run_up
        begun = freeze(source, "run_up", begun, float, q.shape)
        if approach is not None:
            approach = array_of(source, "approach", approach)
            if approach.shape not in (q.shape, q.shape[:1]):
                allowed = f"shape {q.shape[:1]} or {q.shape}"
                raise InputError(source, "approach", f"shape {approach.shape}", allowed)
        for row, joint, allowed in list_wrong_run_ups(q, approach, begun):
            field = f"row {row + 1}, run_up of q{joint + 1}"
            raise InputError(source, field, begun[row, joint], allowed)
        history = recorded_history(q, index, approach, begun)
        return cls(
            *(index, q, xyz, history.approach, repeat_id),
            source=source,
            legs=history.legs,
            last_way=history.last_way,
            told=read_sides(q, approach, begun),
            touch_distances=tuple(touch_distances),
            **{name: value for name, value in further.items() if value is not None},
        )

    def with_run_ups(self, lengths: np.ndarray) -> Session:
        """Return the session with assumed lengths (n,), rad and m, of run-ups of unknown length."""
        if not self.told.any():
            return self
        history = recorded_history(self.q, self.index, self.told, self.run_up, lengths)
        return dataclasses.replace(self, legs=history.legs, last_way=history.last_way)

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        seen = int(self.seen.sum())
        what = "marker seen" if self.plain else "measured"
        return f"Session({self.source}: {len(self)} rows of {self.n} joints, {what} in {seen})"

    def _repr_html_(self) -> str:
        """Return an HTML table of the first eight rows."""
        names = ("index", *(f"q{j}" for j in range(1, self.n + 1)), "x", "y", "z")
        numbers = zip(self.index.tolist(), self.q.tolist(), self.xyz.tolist(), strict=True)
        rows = [dict(zip(names, (k, *q, *xyz), strict=True)) for k, q, xyz in islice(numbers, 8)]
        return html_table(repr(self), rows)

    @property
    def n(self) -> int:
        """The number n of commanded joints, columns of q."""
        return self.q.shape[1]

    @property
    def t_s(self) -> np.ndarray | None:
        """Time of each row in s, (N,); None if it was not recorded."""
        return self.columns.get("t_s")

    @property
    def ended_s(self) -> float | None:
        """The latest time of its rows, s after `begun_s`; None if no time was recorded."""
        return None if self.t_s is None else float(self.t_s.max() - self.begun_s)

    @cached_property
    def share_of_time(self) -> np.ndarray:
        """(N,) time of each row, scaled to 0..1; the row's index is used if no time is known."""
        when = np.asarray(self.index if self.t_s is None else self.t_s, float)
        return (when - when.min()) / max(float(np.ptp(when)), 1e-300)

    @cached_property
    def run_up(self) -> np.ndarray:
        """(N, n) joint value where the run-up began, rad and m.

        NaN where the joint came straight from the row before, or the run-up is not known.
        """
        straight, leg = straight_ways(self.q, self.index), self.legs[..., 0]
        known = ~np.isnan(straight)
        way = np.where(known, self.last_way, leg)
        came_straight = np.abs(way - np.where(known, straight, 0.0)) < SAME_POSE
        again = first_of_stand(self.q, self.index) < np.arange(len(self))
        return np.where(came_straight | again[:, None] | (self.told != 0), np.nan, self.q - way)

    @cached_property
    def sides(self) -> np.ndarray:
        """(N, n) sides of arrival to record: those in `told`; after a gap, all that are known."""
        return np.where(np.isnan(straight_ways(self.q, self.index)), self.approach, self.told)

    @cached_property
    def arrivals(self) -> tuple[tuple[int, int], ...]:
        """Per joint, the numbers of rows from above and from below; empty if no side is known."""
        if not self.approach.any():
            return ()
        above, below = (self.approach < 0).sum(axis=0), (self.approach > 0).sum(axis=0)
        return tuple(zip(above.tolist(), below.tolist(), strict=True))

    @cached_property
    def row_legs(self) -> tuple[float, ...]:
        """Per joint, the distance (rad, m) since its last reversal that 75 % of the rows reach.

        Rows without a recorded distance do not count: 0 for a joint with none, empty if there is
        none at all.
        """
        legs = np.where(self.legs[..., 0] == 0.0, np.nan, np.abs(self.legs[..., 0]))
        known = np.isfinite(legs).any(axis=0)
        if not known.any():
            return ()
        usual = np.zeros(legs.shape[1])
        usual[known] = np.nanquantile(legs[:, known], 0.25, axis=0)
        return tuple(usual.tolist())

    @cached_property
    def pose_id(self) -> np.ndarray:
        """(N,) number of each row's pose; rows with equal joints or one `repeat_id` share it."""
        keys = np.round(self.q / SAME_POSE).astype(np.int64)
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        pose = first[inverse.reshape(-1)]
        for repeat in np.unique(self.repeat_id[self.repeat_id >= 0]):
            alike = np.unique(pose[self.repeat_id == repeat])
            pose[np.isin(pose, alike)] = alike[0]
        return pose

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the contents. Equal rows have equal hashes, independent of the source file."""
        digest = hashlib.sha256()
        run_up = self.run_up if np.isfinite(self.run_up).any() else None
        parts: list[tuple[str, np.ndarray | None]] = [
            *(("index", self.index), ("q", self.q), ("xyz", self.xyz)),
            *(("approach", self.approach), ("run_up", run_up)),
            *(("repeat_id", self.repeat_id), ("sigma", self.sigma)),
            *sorted(self.columns.items()),
            *sorted(self.readings.items()),
            *((f"sigma {name}", values) for name, values in sorted(self.sigmas.items())),
        ]
        for name, values in parts:
            if values is not None:
                digest.update(f"{name}{values.shape}".encode())
                digest.update(np.ascontiguousarray(values).tobytes())
        if self.touch_distances:
            digest.update(repr(self.touch_distances).encode())
        for name in sorted(self.labels):
            digest.update("\0".join([name, *self.labels[name]]).encode())
        return digest.hexdigest()

    def context(self) -> Context:
        """Return the circumstances of the rows; every scalar is (N,).

        The history of the joints is left out if no side of arrival is known.
        """
        history = History(self.approach.astype(float), self.legs, self.last_way)
        columns = dict(self.columns)
        if self.t_s is not None:
            columns["t_s"] = self.t_s - self.begun_s
        return Context(
            **(history.fields() if self.approach.any() else {}), columns=columns, labels=self.labels
        )

    def take(self, rows: _Rows) -> Session:
        """Return some of the rows: a mask (N,), indices or a slice."""
        taken: dict[str, Any] = {}
        for each in dataclasses.fields(self):
            held = getattr(self, each.name)
            if isinstance(held, np.ndarray):
                taken[each.name] = held[rows]
            elif each.name in _BY_NAME:
                taken[each.name] = {name: values[rows] for name, values in held.items()}
        return dataclasses.replace(self, **taken)

    def followed_by(self, more: Session) -> Session:
        """Return the session with more rows after its own, numbered on from its last one.

        What only one of both records is blank in the rows of the other.

        Raises:
            InputError: only one of both has a number that every row needs, such as `payload_kg`.
        """
        both: dict[str, Any] = {}
        for kind in _BY_NAME:
            pair = getattr(self, kind), getattr(more, kind)
            both[kind] = {
                name: np.concatenate(
                    [
                        held[name] if name in held else _blank(like, len(rows))
                        for held, rows in zip(pair, (self, more), strict=True)
                    ]
                )
                for name, like in {**pair[0], **pair[1]}.items()
            }
        if self.sigma is not None or more.sigma is not None:
            sigmas = [s.xyz * np.nan if s.sigma is None else s.sigma for s in (self, more)]
            both["sigma"] = np.concatenate(sigmas)
        for name in ("q", "xyz", "run_up", "repeat_id"):
            both[name] = np.concatenate([getattr(self, name), getattr(more, name)])
        return Session.record(
            index=np.concatenate([self.index, self.index[-1] + 1 + np.arange(len(more))]),
            approach=np.concatenate([self.sides, more.sides]),
            source=self.source,
            touch_distances=tuple(dict.fromkeys((*self.touch_distances, *more.touch_distances))),
            begun_s=self.begun_s,
            lost=self.lost,
            **both,
        )

    def on_clock_of(self, other: Session) -> Session:
        """Return the session with the start of the time (`begun_s`) of another session."""
        return dataclasses.replace(self, begun_s=other.begun_s)

    def where(self, label: str, value: str) -> Session:
        """Return the rows whose text column `label` holds `value`; InputError without it."""
        if label not in self.labels:
            known = ", ".join(self.labels) or "none"
            raise self.error(label, "missing", f"a text column (there are: {known})")
        return self.take(self.labels[label] == value)


def _joints(where: str, q: np.ndarray) -> np.ndarray:
    q = array_of(where, "q", q)
    if q.ndim != 2 or q.shape[1] < 1:
        raise InputError(where, "q", f"shape {q.shape}", "(N, n) commanded joints")
    if not np.isfinite(q).all():
        raise InputError(where, "q", "not finite", "finite numbers in rad or m")
    return q


def _blank(like: np.ndarray, rows: int) -> np.ndarray:
    """Return so many rows of blanks: NaN, or "" where the values are text."""
    return np.full((rows, *like.shape[1:]), "" if like.dtype.kind == "U" else np.nan)
