"""Rows of a session, each made as soon as nothing that is read later can change it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from longarm_comp.core.arm.history import History
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.rest import Sighting, nowhere, settled, stood
from longarm_comp.core.data.session import INCLINATION, Session
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.message_buffer import MessageBuffer, SessionRow
from longarm_comp.sessions.message_types import CLOCKS_APART


class _Row(NamedTuple):
    number: int
    q: np.ndarray
    history: History
    sides: np.ndarray
    seen: Sighting
    read: np.ndarray
    told: SessionRow
    held: dict[str, float]


class Rows:
    """What the arm did, command by command, taken off a buffer."""

    def __init__(self, buffer: MessageBuffer) -> None:
        self._buffer = buffer
        self._at: np.ndarray | None = None  # joints of the command before
        self._history = History.unknown(buffer.arm.n)
        self._rows: list[_Row] = []
        self._lost: dict[int, str] = {}
        self._passed = False

    def close(self, *, everything: bool = False) -> None:
        """Finish every command whose time is over, so that the buffer can forget it.

        A sighting may be recorded up to `CLOCKS_APART` after it was taken.
        """
        commands = self._buffer.commands
        while len(commands) > 1 and (
            everything or commands[-1][0] >= commands[1][0] + CLOCKS_APART
        ):
            self._finish(commands[1][0])
        if everything and commands:
            self._finish(math.inf)

    def _finish(self, end: float) -> None:
        """The oldest command, which the next one followed at `end` (s)."""
        buffer = self._buffer
        begin, points = buffer.commands.popleft()
        sightings, rows = buffer.sightings_between(begin, end), buffer.rows_between(begin, end)
        states = buffer.states_between(begin, end)
        seen, why = settled(sightings, *states, begin)
        row = rows[0][1] if rows else SessionRow()
        passed = seen is None
        if seen is None and rows:  # a measurement was meant: it is a row, and says why it is blank
            seen = nowhere(rows[0][0])
        last = self._rows[-1].number if self._rows else -1
        number = row.index if row.index is not None else last + 1
        gap = not passed and self._rows and not self._passed and not 0 <= number - last <= 1
        if gap:
            self._at, self._history = None, History.unknown(buffer.arm.n)
        self._history = self._history.after(points, self._at).told(_sides(row, buffer))
        self._at = points[-1]
        self._passed = passed
        if seen is not None:
            held = {name: held.at(seen.t) for name, held in buffer.columns.items()}
            told, read = _sides(row, buffer), stood(*states, begin)
            self._rows.append(_Row(number, self._at, self._history, told, seen, read, row, held))
            if why:
                self._lost[number] = why
        buffer.forget(end)

    def session(self) -> Session:
        """All rows."""
        buffer = self._buffer
        if not self._rows:
            allowed = "a sighting per command"
            raise InputError(buffer.where, "tip_measured", "none after a command", allowed)
        rows = self._rows
        variance = np.array([row.seen.variance for row in rows])
        blank = np.array([np.isnan(row.seen.xyz).any() for row in rows])
        columns = {"t_s": np.array([row.seen.t for row in rows])}
        for name, held in buffer.columns.items():
            columns[name] = np.array([row.held.get(name, held.first) for row in rows])
        columns |= _told([row.told.columns for row in rows])
        readings = self._readings()
        return Session(
            index=np.array([row.number for row in rows]),
            q=np.array([row.q for row in rows]),
            xyz=readings.pop("position"),
            approach=np.array([row.history.approach for row in rows]),
            legs=np.array([row.history.legs for row in rows]),
            told=np.array([row.sides for row in rows]),
            repeat_id=np.array([row.told.repeat_id for row in rows]),
            sigma=np.sqrt(np.where(blank[:, None] & (variance <= 0), np.nan, variance))
            if (variance[~blank] > 0).all() and not blank.all()
            else None,
            columns=columns,
            labels=_told([row.told.labels for row in rows]),
            source=buffer.where,
            readings=readings,
            sigmas=self._sigmas(),
            lost=self._lost,
        )

    def _readings(self) -> dict[str, np.ndarray]:
        """What was measured, by kind: what was sighted, and what the rows tell."""
        made = {
            "position": np.array([row.seen.xyz for row in self._rows]),
            "orientation": np.array([row.seen.quaternion for row in self._rows]),
        }
        joints = np.array([row.read for row in self._rows]).T[..., None]
        made |= {f"read_q{k}": values for k, values in enumerate(joints, 1)}
        for name in sorted({name for row in self._rows for name in row.told.readings}):
            if name not in KINDS:
                where = "session_row readings"
                raise InputError(self._buffer.where, where, name, ", ".join(KINDS))
            blank = [math.nan] * len(KINDS[name].cells)
            told = np.array([row.told.readings.get(name, blank) for row in self._rows], dtype=float)
            made[name] = np.where(np.isnan(told), made.get(name, told), told)
        return made

    def _sigmas(self) -> dict[str, np.ndarray]:
        spread = np.array([row.seen.turn_variance for row in self._rows])
        made = {"orientation": np.where(spread > 0, np.sqrt(spread), np.nan)}
        for name in sorted({name for row in self._rows for name in row.told.sigmas}):
            told = np.array([row.told.sigmas.get(name, math.nan) for row in self._rows])
            made[name] = np.where(np.isnan(told), made.get(name, told), told)
        return {name: values for name, values in made.items() if np.isfinite(values).any()}


def _sides(row: SessionRow, buffer: MessageBuffer) -> np.ndarray:
    """(n,) sides of arrival that were recorded without the length of the run-up, else 0."""
    n = buffer.arm.n
    if len(row.approach) not in (0, n):
        raise InputError(buffer.where, "session_row approach", row.approach, f"{n} sides")
    return np.array(row.approach or [0] * n, float)


def _told(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Columns of what every row's `session_row` tells."""
    every = dict.fromkeys(name for row in rows for name in row)
    names = [n for n in every if INCLINATION.match(n) or all(n in row for row in rows)]
    return {name: np.array([row.get(name, math.nan) for row in rows]) for name in names}
