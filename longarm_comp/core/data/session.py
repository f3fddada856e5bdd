"""A session: commanded joints, measured tips and their circumstances.

Rows keep the order in which they were recorded.  Quantities that depend on that order (the side
from which a joint arrived) are derived once, here, so that any subset may be taken afterwards.
See `core/data/holdout.py` for splits and the sealed hold-out.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.context import PER_JOINT, Context
from longarm_comp.core.arm.history import SAME_POSE, recorded
from longarm_comp.core.errors import InputError

Rows = np.ndarray | Sequence[int] | slice


@dataclass(frozen=True, eq=False)
class Session:
    """N measurements of an arm with n commanded joints. Arrays are read-only.

    Attributes:
        index: (N,) counter of the recording. A step other than 0 or 1 is a gap.
        q: (N, n) commanded joints, rad and m.
        xyz: (N, 3) measured tip, m. A row of NaN is a lost marker.
        approach: (N, n) side each joint arrived from: +1 from below, -1 from above, 0 unknown.
        repeat_id: (N,) rows with the same number revisit one pose; -1 for none.
        sigma: (N, 3) standard deviation of the measurement in m, or None.
        columns: further numbers by name, (N,) each, finite: `t_s`, `temperature_c`,
            `payload_kg`, `incl_<frame>_x`, any other quantity that was recorded.
        labels: text by name, (N,) each: `group`, `marker`, `role`, any other.
        source: file or bag that it came from, for messages.
        travel: (N, n) signed travel of each joint since it last reversed, rad and m, over the
            rows before, without the final approach; 0 unknown.
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
    travel: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check the shapes and freeze the arrays."""
        q = _joints(self.source, self.q)
        n_rows, n = q.shape
        xyz = np.asarray(self.xyz, dtype=float)
        lost = np.isnan(xyz)
        if xyz.shape == (n_rows, 3) and (np.isinf(xyz).any() or (lost.any(1) != lost.all(1)).any()):
            raise InputError(self.source, "xyz", "not finite", "three numbers in m, or three NaN")
        self._set("index", np.asarray(self.index, dtype=np.int64), (n_rows,))
        self._set("q", q, (n_rows, n))
        self._set("xyz", xyz, (n_rows, 3))
        self._set("approach", np.asarray(self.approach, dtype=np.int8), (n_rows, n))
        travel = np.zeros((n_rows, n)) if self.travel is None else self.travel
        self._set("travel", np.asarray(travel, dtype=float), (n_rows, n))
        self._set("repeat_id", np.asarray(self.repeat_id, dtype=np.int64), (n_rows,))
        if self.sigma is not None:
            self._set("sigma", np.asarray(self.sigma, dtype=float), (n_rows, 3))
        columns = {k: np.asarray(v, dtype=float) for k, v in self.columns.items()}
        labels = {k: np.asarray(v, dtype=str) for k, v in self.labels.items()}
        for kind, held in (("columns", columns), ("labels", labels)):
            for name, values in held.items():
                _check_shape(self.source, name, values, (n_rows,))
                values.flags.writeable = False
            object.__setattr__(self, kind, held)
        for name, values in columns.items():
            if not np.isfinite(values).all():
                raise InputError(self.source, name, "not finite", "a finite number in every row")

    def _set(self, name: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
        _check_shape(self.source, name, values, shape)
        frozen = values.view()
        frozen.flags.writeable = False
        object.__setattr__(self, name, frozen)

    @classmethod
    def record(
        cls,
        q: np.ndarray,
        xyz: np.ndarray,
        *,
        index: np.ndarray | None = None,
        approach: np.ndarray | None = None,
        repeat_id: np.ndarray | None = None,
        sigma: np.ndarray | None = None,
        columns: Mapping[str, np.ndarray] | None = None,
        labels: Mapping[str, np.ndarray] | None = None,
        source: str = "session",
    ) -> Session:
        """Create from rows in the order of recording. The approach of each joint is derived.

        Args:
            q: (N, n), rad and m.
            xyz: (N, 3), m.
            index: (N,); counted from 0 when not given.
            approach: as recorded: (N,) for all joints or (N, n). 0 or NaN, or no array, means
                that it is derived from the row before.
            repeat_id: as in `Session`; so are the others.

        Raises:
            InputError: shapes do not fit, or a number is not finite.
        """
        q = _joints(source, q)
        n_rows = len(q)
        index = np.arange(n_rows) if index is None else np.asarray(index)
        _check_shape(source, "index", index, (n_rows,))
        repeat_id = np.full(n_rows, -1) if repeat_id is None else repeat_id
        history = recorded(q, index, approach)
        return cls(
            index,
            q,
            xyz,
            history.approach,
            repeat_id,
            sigma,
            columns or {},
            labels or {},
            source,
            history.travel,
        )

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.q)

    def __repr__(self) -> str:
        seen = int(self.seen.sum())
        return f"Session({self.source}: {len(self)} rows of {self.n} joints, marker seen in {seen})"

    @property
    def n(self) -> int:
        """Number of commanded joints."""
        return self.q.shape[1]

    @property
    def t_s(self) -> np.ndarray | None:
        """Time of each row in s, (N,), where recorded."""
        return self.columns.get("t_s")

    @property
    def temperature_c(self) -> np.ndarray | None:
        """Temperature of each row in degrees Celsius, (N,), where recorded."""
        return self.columns.get("temperature_c")

    @property
    def payload_kg(self) -> np.ndarray | None:
        """Carried mass of each row in kg, (N,), where recorded."""
        return self.columns.get("payload_kg")

    @cached_property
    def seen(self) -> np.ndarray:
        """(N,) whether the marker was seen."""
        return ~np.isnan(self.xyz[:, 0])

    @cached_property
    def arrivals(self) -> tuple[tuple[int, int], ...]:
        """Per joint, rows that arrived from above (-1) and below (+1); empty if not recorded."""
        if not self.approach.any():
            return ()
        above, below = (self.approach < 0).sum(axis=0), (self.approach > 0).sum(axis=0)
        return tuple(zip(above.tolist(), below.tolist(), strict=True))

    @cached_property
    def pose_id(self) -> np.ndarray:
        """(N,) a number per pose: rows of equal joints, or of one `repeat_id`, share it."""
        keys = np.round(self.q / SAME_POSE).astype(np.int64)
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        pose = first[inverse.reshape(-1)]
        for repeat in np.unique(self.repeat_id[self.repeat_id >= 0]):
            alike = np.unique(pose[self.repeat_id == repeat])
            pose[np.isin(pose, alike)] = alike[0]
        return pose

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the contents. Equal rows give equal hashes, whatever file they are in."""
        digest = hashlib.sha256()
        parts: list[tuple[str, np.ndarray | None]] = [
            ("index", self.index),
            ("q", self.q),
            ("xyz", self.xyz),
            ("approach", self.approach),
            ("repeat_id", self.repeat_id),
            ("sigma", self.sigma),
            *((name, self.columns[name]) for name in sorted(self.columns)),
        ]
        for name, values in parts:
            if values is not None:
                digest.update(f"{name}{values.shape}".encode())
                digest.update(np.ascontiguousarray(values).tobytes())
        for name in sorted(self.labels):
            digest.update("\0".join([name, *self.labels[name]]).encode())
        return digest.hexdigest()

    def context(self, rows: Rows | None = None) -> Context:
        """Circumstances of some rows, or all, for the effects. Scalars are (N,) arrays.

        The history of the joints is absent when no side of arrival is known in the whole session.
        """
        at: Rows = slice(None) if rows is None else rows
        history = {
            name: tuple(getattr(self, name)[at, j].astype(float) for j in range(self.n))
            for name in (PER_JOINT if self.approach.any() else ())
        }
        return Context(
            **history,
            columns={name: values[at] for name, values in self.columns.items()},
            labels={name: values[at] for name, values in self.labels.items()},
        )

    def take(self, rows: Rows) -> Session:
        """Some of the rows: a mask (N,), indices or a slice."""
        return dataclasses.replace(
            self,
            index=self.index[rows],
            q=self.q[rows],
            xyz=self.xyz[rows],
            approach=self.approach[rows],
            travel=None if self.travel is None else self.travel[rows],
            repeat_id=self.repeat_id[rows],
            sigma=None if self.sigma is None else self.sigma[rows],
            columns={name: values[rows] for name, values in self.columns.items()},
            labels={name: values[rows] for name, values in self.labels.items()},
        )

    def where(self, label: str, value: str) -> Session:
        """The rows whose text column `label` holds `value`.

        Raises:
            InputError: there is no such column.
        """
        if label not in self.labels:
            known = ", ".join(self.labels) or "none"
            raise InputError(self.source, label, "missing", f"a text column (there are: {known})")
        return self.take(self.labels[label] == value)


def _check_shape(where: str, name: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise InputError(where, name, f"shape {values.shape}", f"shape {shape}")


def _joints(where: str, q: np.ndarray) -> np.ndarray:
    q = np.asarray(q, dtype=float)
    if q.ndim != 2 or q.shape[1] < 1:
        raise InputError(where, "q", f"shape {q.shape}", "(N, n) commanded joints")
    if not np.isfinite(q).all():
        raise InputError(where, "q", "not finite", "finite numbers in rad or m")
    return q
