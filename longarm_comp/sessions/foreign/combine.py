"""Combines tables into one session's table: rows of several days, or joints and tracker points.

It also makes rows of markers that stand side by side, and sorts rows by a column.
"""

import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.sessions.foreign.cells import Cells
from longarm_comp.sessions.foreign.columns import find_meaning
from longarm_comp.sessions.foreign.poses import find_forms, headings, unit_in
from longarm_comp.sessions.foreign.units import TIME, seconds, split_name

_COUNTED = re.compile(r"\d+|\b[A-Za-z]\b")


def append_tables(tables: Sequence[Cells]) -> Cells:
    """Append the rows of tables that have the same columns.

    A number is left out between their indices, because the history of the joints breaks off there.

    Raises:
        InputError: a table has other columns.
    """
    first, *others = map(_with_points, tables)
    rows, index = list(first.rows), list(range(len(first.rows)))
    for table in others:
        if sorted(table.names) != sorted(first.names):
            other = sorted(set(table.names) ^ set(first.names))
            allowed = f"the columns of {first.where}, or --join COLUMN"
            raise InputError(table.where, "columns", ", ".join(other), allowed)
        order = [table.names.index(name) for name in first.names]
        begin = index[-1] + 2  # a gap: nobody knows what the joints did between
        rows += [(line, tuple(row[k] for k in order)) for line, row in table.rows]
        index += range(begin, begin + len(table.rows))
    where = ", ".join(table.where for table in tables)
    return replace(first, where=where, rows=tuple(rows), index=tuple(index))


def join_tables(tables: Sequence[Cells], column: str) -> tuple[Cells, tuple[str, ...]]:
    """Join tables side by side: rows with the same number or text in a column, or nearest times.

    Returns:
        The table; and notes that say how near the times are, and which rows have no partner.

    Raises:
        InputError: a value occurs twice in a further table, or no rows belong together.
    """
    made, *others = map(_with_points, tables)
    notes: list[str] = []
    for table in others:
        here, there = (t.place(column, "--join") for t in (made, table))
        one, two = ([row[k] for _, row in t.rows] for t, k in ((made, here), (table, there)))
        places: dict[object, int] = {}
        for k, ((line, _), text) in enumerate(zip(table.rows, two, strict=True)):
            if _sort_key(text) in places:
                raise InputError(table.where, f"line {line}, {column}", text, "each of them once")
            if not table.empty(text):  # rows without a number or name have no partner
                places[_sort_key(text)] = k
        partner = [places.get(_sort_key(text), -1) for text in one]
        clocks, allowed = _read_clocks((made, table), (here, there), column), f"{one[0]}, ..."
        if clocks:
            partner, limit = _pair_nearest(*clocks)
            apart = [abs(clocks[0][k] - clocks[1][p]) for k, p in enumerate(partner) if p >= 0]
            farthest = f"; the farthest are {max(apart):.3g} apart" if apart else ""
            notes.append(f"{table.where}: nearest {column} within {limit:.3g}{farthest}")
            allowed = f"times of one clock, within {limit:.3g}: {allowed}"
        left = sorted(set(range(len(two))) - set(partner))
        for where, keys in (
            (made.where, [one[k] for k, p in enumerate(partner) if p < 0]),
            (table.where, [two[k] for k in left]),
        ):
            if keys:
                named = ", ".join(key or "(blank)" for key in keys[:20])
                notes.append(f"{where}: no partner of {column} {named}")
        kept = [k for k in range(len(table.names)) if k != there]
        names = [table.names[k] for k in kept]
        names = [f"{Path(table.where).stem} {n}" if n in made.names else n for n in names]
        rows = tuple(
            (line, (*row, *(table.rows[p][1][k] for k in kept)))
            for (line, row), p in zip(made.rows, partner, strict=True)
            if p >= 0
        )
        if not rows:
            raise InputError(table.where, f"--join {column}", "no row in common", allowed)
        made = replace(made, names=(*made.names, *names), rows=rows)
    return replace(made, where=", ".join(t.where for t in tables)), tuple(notes)


def sort_rows(cells: Cells, column: str) -> Cells:
    """Sort the rows by a column: as times or numbers if all its cells are such, else as text.

    Raises:
        InputError: a cell is blank, which alone would make texts of numbers: 10 before 9.
    """
    place = cells.place(column, "--sort")
    texts = [row[place] for _, row in cells.rows]
    for (line, _), text in zip(cells.rows, texts, strict=True):
        if cells.empty(text):
            raise InputError(cells.where, f"line {line}, {column}", text, "a value to sort by")
    numbers = [cells.number(text) for text in texts]
    clock = seconds(texts)
    keys: Sequence[Any] = texts if None in numbers else numbers
    keys = keys if clock is None else clock.tolist()
    order = sorted(range(len(texts)), key=keys.__getitem__)
    rows, index = tuple(cells.rows[k] for k in order), cells.index
    if index:  # a gap stays wherever a row of another file follows
        file = np.searchsorted(cells.breaks, order, side="right")
        gaps = np.cumsum(np.diff(file, prepend=file[0]) != 0)
        index = tuple((np.arange(len(rows)) + gaps).tolist())
    return replace(cells, rows=rows, index=index)


def find_marker_headings(cells: Cells, told: Collection[str]) -> tuple[str, ...]:
    """Find the headings of markers whose x, y and z stand side by side; empty where there are none.

    These headings differ in a number or a letter only: M1, M2; prism A, prism B.

    Args:
        told: columns that the user mapped. If one of them is a marker's, there are no headings.
    """
    found = find_forms(cells.names)
    names = [cells.names[k] for each in found if not each.turn for k in each.places]
    if any(key in (n, split_name(n)[0]) for n in names for key in told):
        return ()
    whole = [heading for heading in headings(found) if heading]
    alike = {_COUNTED.sub("#", heading) for heading in whole}
    return tuple(whole) if len(whole) > 1 and len(alike) == 1 else ()


def melt_markers(cells: Cells, markers: Sequence[str], turns: bool) -> Cells:
    """Make one row for each marker, with its name in a column `marker`.

    Args:
        markers: their headings, as `find_marker_headings` returns them.
        turns: whether to keep their orientations.

    Raises:
        InputError: the markers' orientations or units differ in form.
    """
    found = find_forms(cells.names)
    positions = headings(found)
    told = {t.heading: t for t in reversed(found) if turns and t.turn and t.heading in markers}
    if len({turn.form for turn in told.values()}) > 1:
        several = ", ".join(cells.names[t.places[0]] for t in told.values())
        raise InputError(cells.where, "orientations", several, "one form for all markers")
    first = next((m for m in markers if m in told), markers[0])
    turn = told.get(first)
    none = (-1,) * (len(turn.places) if turn else 0)
    places = {
        marker: (*positions[marker].places, *(told[marker].places if marker in told else none))
        for marker in markers
    }
    for column in zip(*places.values(), strict=True):
        same = [cells.names[k] for k in column if k >= 0]
        if len(set(map(unit_in, same))) > 1:
            raise InputError(cells.where, "units", ", ".join(same), "one for all markers")
    taken = {k for held in places.values() for k in held}
    rest = [k for k in range(len(cells.names)) if k not in taken]
    parts = [*"xyz", *(turn.word + part for part in turn.form.parts)] if turn else [*"xyz"]
    units = [unit_in(cells.names[k]) for k in places[first]]
    axes = [f"{a} [{unit.name}]" if unit else a for a, unit in zip(parts, units, strict=True)]
    rows, index = [], []
    for number, (line, row) in enumerate(cells.rows):
        for marker in markers:
            tip = ("" if k < 0 else row[k] for k in places[marker])
            rows.append((line, (*(row[k] for k in rest), *tip, marker)))
            index.append(cells.index[number] if cells.index else number)
    names = (*(cells.names[k] for k in rest), *axes, "marker")
    return replace(cells, names=names, rows=tuple(rows), index=tuple(index))


def _read_clocks(tables: Sequence[Cells], places: Sequence[int], column: str) -> list[np.ndarray]:
    """Return the times in a column of each of two tables; empty if they hold no times.

    They are in s, or as written if no unit is stated.
    """
    texts = [table.column(place) for table, place in zip(tables, places, strict=True)]
    both = seconds([*texts[0], *texts[1]])
    if both is not None:
        return [both[: len(texts[0])], both[len(texts[0]) :]]
    named = [split_name(table.names[place]) for table, place in zip(tables, places, strict=True)]
    timed = [unit.kind == TIME if unit else find_meaning(stem) == "t_s" for stem, unit in named]
    numbers = [[t.number(text) for text in own] for t, own in zip(tables, texts, strict=True)]
    if not all(timed) or any(None in own for own in numbers):
        return []
    units = [unit for _, unit in named]
    if units.count(None) == 1:
        allowed = f"a unit in both files: {named[0][0]} [s]"
        raise InputError(tables[units.index(None)].where, f"--join {column}", "no unit", allowed)
    return [
        np.array(own, dtype=float) * (unit.factor if unit else 1.0)
        for own, unit in zip(numbers, units, strict=True)
    ]


def _pair_nearest(one: np.ndarray, two: np.ndarray) -> tuple[list[int], float]:
    """Pair each time of ``one`` with the nearest time of ``two`` that has no nearer one itself.

    Returns the indices in ``two``, -1 if none is within the tolerance, and the tolerance: half of
    the smaller of both median steps.
    """
    near, back = _find_closest(one, two), _find_closest(two, one)
    steps = [np.diff(np.unique(times)) for times in (one, two)]
    limit = min((float(np.median(step)) / 2 for step in steps if len(step)), default=0.0)
    # Of rows of one time all have it
    mutual = np.abs(one - two[near]) <= np.minimum(np.abs(two - one[back])[near], limit)
    return np.where(mutual, near, -1).tolist(), limit


def _find_closest(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return for each number of ``one`` (N,) the index in ``two`` of the number closest to it."""
    order = np.argsort(two, kind="stable")
    after = np.searchsorted(two[order], one).clip(1, max(len(two) - 1, 1))
    pair = order[np.stack([after - 1, np.minimum(after, len(two) - 1)])]
    return pair[np.abs(two[pair] - one).argmin(axis=0), np.arange(len(one))]


def _sort_key(text: str) -> object:
    try:
        return float(text)
    except ValueError:
        return text.strip().lower()


def _with_points(cells: Cells) -> Cells:
    """Return the table with decimal points."""
    if cells.decimal == ".":
        return cells
    rows = tuple(
        (line, tuple(c if cells.number(c) is None else c.replace(",", ".") for c in row))
        for line, row in cells.rows
    )
    return replace(cells, rows=rows, decimal=".")
