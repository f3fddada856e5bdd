"""Rows of a session, each made as soon as nothing that is read later can change it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.history import History
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.session import INCLINATION, Session
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.message_buffer import MessageBuffer, SessionRow
from longarm_comp.sessions.moment import CLOCKS_APART
from longarm_comp.sessions.settled import Sighting, nowhere, settled, stood


class Rows:
    """What the arm did, command by command, taken off a buffer."""

    def __init__(self, buffer: MessageBuffer) -> None:
        self._buffer = buffer
        self._at: np.ndarray | None = None  # joints of the command before
        self._history = History.unknown(buffer.arm.n)
        self._q: list[np.ndarray] = []
        self._came: list[History] = []
        self._sides: list[np.ndarray] = []
        self._made: list[Sighting] = []
        self._read: list[np.ndarray] = []
        self._told: list[SessionRow] = []
        self._index: list[int] = []
        self._lost: dict[int, str] = {}
        self._held: list[dict[str, float]] = []
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
        last = self._index[-1] if self._index else -1
        number = row.index if row.index is not None else last + 1
        gap = not passed and self._index and not self._passed and not 0 <= number - last <= 1
        if gap:
            self._at, self._history = None, History.unknown(buffer.arm.n)
        self._history = self._history.after(points, self._at).told(_sides(row, buffer))
        self._at = points[-1]
        self._passed = passed
        if seen is not None:
            self._q.append(self._at)
            self._came.append(self._history)
            self._sides.append(_sides(row, buffer))
            self._made.append(seen)
            self._read.append(stood(*states, begin))
            self._told.append(row)
            self._index.append(number)
            if why:
                self._lost[number] = why
            self._held.append({name: held.at(seen.t) for name, held in buffer.columns.items()})
        buffer.forget(end)

    def session(self) -> Session:
        """All rows."""
        buffer = self._buffer
        if not self._made:
            allowed = "a sighting per command"
            raise InputError(buffer.where, "tip_measured", "none after a command", allowed)
        variance = np.array([seen.variance for seen in self._made])
        blank = np.array([np.isnan(seen.xyz).any() for seen in self._made])
        columns = {"t_s": np.array([seen.t for seen in self._made])}
        for name, held in buffer.columns.items():
            columns[name] = np.array([row.get(name, held.first) for row in self._held])
        columns |= _told([row.columns for row in self._told])
        readings = self._readings()
        return Session(
            index=np.array(self._index),
            q=np.array(self._q),
            xyz=readings.pop("position"),
            approach=np.array([came.approach for came in self._came]),
            legs=np.array([came.legs for came in self._came]),
            told=np.array(self._sides),
            repeat_id=np.array([row.repeat_id for row in self._told]),
            sigma=np.sqrt(np.where(blank[:, None] & (variance <= 0), np.nan, variance))
            if (variance[~blank] > 0).all() and not blank.all()
            else None,
            columns=columns,
            labels=_told([row.labels for row in self._told]),
            source=buffer.where,
            readings=readings,
            sigmas=self._sigmas(),
            lost=self._lost,
        )

    def _readings(self) -> dict[str, np.ndarray]:
        """What was measured, by kind: what was sighted, and what the rows tell."""
        made = {
            "position": np.array([seen.xyz for seen in self._made]),
            "orientation": np.array([seen.quaternion for seen in self._made]),
        }
        joints = np.array(self._read).T[..., None]
        made |= {f"read_q{k}": values for k, values in enumerate(joints, 1)}
        for name in sorted({name for row in self._told for name in row.readings}):
            if name not in KINDS:
                where = "session_row readings"
                raise InputError(self._buffer.where, where, name, ", ".join(KINDS))
            blank = [math.nan] * len(KINDS[name].cells)
            told = np.array([row.readings.get(name, blank) for row in self._told], dtype=float)
            made[name] = np.where(np.isnan(told), made.get(name, told), told)
        return made

    def _sigmas(self) -> dict[str, np.ndarray]:
        spread = np.array([seen.turn_variance for seen in self._made])
        made = {"orientation": np.where(spread > 0, np.sqrt(spread), np.nan)}
        for name in sorted({name for row in self._told for name in row.sigmas}):
            told = np.array([row.sigmas.get(name, math.nan) for row in self._told])
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
