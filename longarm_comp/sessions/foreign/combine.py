"""Tables of one session put together: days after each other, joints beside the tracker's points,
markers side by side as rows, rows in the order of a column."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.sessions.foreign.cells import Cells
from longarm_comp.sessions.foreign.units import seconds, split_name

_AXIS = re.compile(r"(?i)(.*?)[ _.:-]*([xyz])")
_COUNTED = re.compile(r"\d+|\b[A-Za-z]\b")


def appended(tables: Sequence[Cells]) -> Cells:
    """The rows of tables of the same columns one after the other."""
    first, *others = map(_pointed, tables)
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


def joined(tables: Sequence[Cells], column: str) -> tuple[Cells, tuple[str, ...]]:
    """Rows of several tables side by side where a column says the same number, text or time.

    Returns:
        The table, and in words which rows have no partner.
    """
    made, *others = map(_pointed, tables)
    lonely: list[str] = []
    for table in others:
        here, there = (t.place(column, "--join") for t in (made, table))
        one, two = ([row[k] for _, row in t.rows] for t, k in ((made, here), (table, there)))
        partner = _partners(one, two, table, column)
        left = sorted(set(range(len(two))) - set(partner))
        for where, keys in (
            (made.where, [one[k] for k, p in enumerate(partner) if p < 0]),
            (table.where, [two[k] for k in left]),
        ):
            if keys:
                lonely.append(f"{where}: no partner of {column} {', '.join(keys[:20])}")
        kept = [k for k in range(len(table.names)) if k != there]
        names = [table.names[k] for k in kept]
        names = [f"{Path(table.where).stem} {n}" if n in made.names else n for n in names]
        rows = tuple(
            (line, (*row, *(table.rows[p][1][k] for k in kept)))
            for (line, row), p in zip(made.rows, partner, strict=True)
            if p >= 0
        )
        if not rows:
            raise InputError(table.where, f"--join {column}", "no row in common", f"{one[0]}, ...")
        made = replace(made, names=(*made.names, *names), rows=rows)
    return replace(made, where=", ".join(t.where for t in tables)), tuple(lonely)


def ordered(cells: Cells, column: str) -> Cells:
    """The rows in the order of a column: of numbers, of times, else of the texts."""
    place = cells.place(column, "--sort")
    texts = [row[place] for _, row in cells.rows]
    numbers = [cells.number(text) for text in texts]
    clock = seconds(texts)
    keys: Sequence[Any] = texts if None in numbers else numbers
    keys = keys if clock is None else clock.tolist()
    order = sorted(range(len(texts)), key=keys.__getitem__)
    return replace(cells, rows=tuple(cells.rows[k] for k in order))


def beside_each_other(cells: Cells, told: Collection[str]) -> tuple[str, ...]:
    """Headings of markers whose x, y and z stand side by side; empty where there are none.

    Their headings are alike but for a number or a letter: M1, M2; prism A, prism B.
    """
    groups = _groups(cells)
    names = [cells.names[k] for places in groups.values() for k in places.values()]
    if any(key in (n, split_name(n)[0]) for n in names for key in told):
        return ()
    whole = [heading for heading, places in groups.items() if len(places) == 3 and heading]
    alike = {_COUNTED.sub("#", heading) for heading in whole}
    return tuple(whole) if len(whole) > 1 and len(alike) == 1 else ()


def melted(cells: Cells, headings: Sequence[str]) -> Cells:
    """A row for each marker, with its name in a column `marker`."""
    groups = _groups(cells)
    taken = {k for heading in headings for k in groups[heading].values()}
    rest = [k for k in range(len(cells.names)) if k not in taken]
    units = [split_name(cells.names[groups[headings[0]][axis]])[1] for axis in "xyz"]
    axes = [f"{a} [{unit.name}]" if unit else a for a, unit in zip("xyz", units, strict=True)]
    rows, index = [], []
    for number, (line, row) in enumerate(cells.rows):
        for heading in headings:
            tip = (row[groups[heading][axis]] for axis in "xyz")
            rows.append((line, (*(row[k] for k in rest), *tip, heading)))
            index.append(cells.index[number] if cells.index else number)
    names = (*(cells.names[k] for k in rest), *axes, "marker")
    return replace(cells, names=names, rows=tuple(rows), index=tuple(index))


def _groups(cells: Cells) -> dict[str, dict[str, int]]:
    """By heading, the places of x, y and z."""
    groups: dict[str, dict[str, int]] = {}
    for place, name in enumerate(cells.names):
        found = _AXIS.fullmatch(split_name(name)[0])
        if found:
            groups.setdefault(found[1].strip(), {}).setdefault(found[2].lower(), place)
    return groups


def _partners(one: list[str], two: list[str], table: Cells, column: str) -> list[int]:
    """By entry of ``one``, the place of its like in ``two``; -1: it has none."""
    clocks = seconds([*one, *two])
    if clocks is not None and not set(one) & set(two):
        import pandas as pd

        left = pd.DataFrame({"t": clocks[: len(one)], "a": range(len(one))}).sort_values("t")
        right = pd.DataFrame({"t": clocks[len(one) :], "b": range(len(two))}).sort_values("t")
        steps = np.concatenate([np.diff(f["t"]) for f in (left, right)])
        near = float(np.median(steps[steps > 0])) / 2 if (steps > 0).any() else 0.0
        both = pd.merge_asof(left, right, on="t", direction="nearest", tolerance=near)
        return both.sort_values("a")["b"].fillna(-1).astype(int).tolist()
    places: dict[object, int] = {}
    for place, text in enumerate(two):
        if _key(text) in places:
            line = table.rows[place][0]
            raise InputError(table.where, f"line {line}, {column}", text, "each of them once")
        places[_key(text)] = place
    return [places.get(_key(text), -1) for text in one]


def _key(text: str) -> object:
    try:
        return float(text)
    except ValueError:
        return text.strip().lower()


def _pointed(cells: Cells) -> Cells:
    """With decimal points."""
    if cells.decimal == ".":
        return cells
    rows = tuple(
        (line, tuple(c if cells.number(c) is None else c.replace(",", ".") for c in row))
        for line, row in cells.rows
    )
    return replace(cells, rows=rows, decimal=".")
