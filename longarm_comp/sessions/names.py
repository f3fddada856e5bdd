"""Checks of column names. The error for a misspelt name gives the most likely known one."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

from longarm_comp.core.errors import InputError
from longarm_comp.sessions.foreign.units import split_name

_FOREIGN = re.compile(r"(?i)(q|j|joint|axis|a|theta)[ _]?\d+|[xyz]|(p|pos|tip|tcp|meas)[ _.]?[xyz]")


def check_header(where: str, header: Sequence[str], required: Collection[str]) -> None:
    """Raise `InputError` for a column that is empty, doubled or missing."""
    for place, name in enumerate(header, 1):
        if not name:
            raise InputError(where, f"header, column {place}", name, "a name")
        if header.index(name) != place - 1:
            raise InputError(where, f"column {name}", "twice", "each column once")
    for name in required:
        if name not in header:
            near = nearest(name, header)
            hint = f" (is it {near}?)" if near else ""
            allowed = " ".join(required)
            if "q1" in (*required, *header):  # a session, which it converts
                allowed += conversion(where, header)
            raise InputError(where, f"column {name}", f"missing{hint}", allowed)


def conversion(where: str, header: Sequence[str]) -> str:
    """The call that converts a table of another program, where its names look like one's."""
    split = [split_name(name) for name in header]
    suffixed = [unit for name, unit in split if unit is not None and _FOREIGN.fullmatch(name)]
    bare = [name for name, unit in split if unit is None and _FOREIGN.fullmatch(name)]
    others = [name for name in bare if not re.fullmatch(r"q\d+|[xyz]", name)]
    if not suffixed and not others:
        return ""
    units = " --units mm,deg" if bare else ""
    return f"; to convert it: longarm import-data {where} -o samples.csv{units}"


def check_unknown(
    where: str, names: Collection[str], known: Collection[str], kept: Collection[str] = ()
) -> None:
    """Raise `InputError` for an unknown name that comes close to a known one.

    Close: the same but for case, blanks and punctuation; without its unit (`temperature`);
    one edit away, or two in a name of eight letters or more.  A column with any other name is
    kept as context.
    """
    for name in names:
        if name in known or name in kept:
            continue
        meant = nearest(name, known)
        if meant is not None:
            raise InputError(
                where, f"column {name}", f"unknown, close to {meant}", f"{meant}, or another name"
            )


def nearest(name: str, known: Collection[str]) -> str | None:
    """The known name that `name` most likely means, or None."""
    plain = _plain(name)
    for candidate in known:
        if plain in (_plain(candidate), _plain(re.sub(r"_(c|kg|s|id|m|rad)$", "", candidate))):
            return candidate
    within = {candidate: _edits(plain, _plain(candidate)) for candidate in known}
    allowed = 2 if len(plain) >= 8 else 1 if len(plain) >= 4 else 0
    best = min(within, key=within.__getitem__, default=None)
    return best if best is not None and within[best] <= allowed else None


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _edits(a: str, b: str) -> int:
    """Edits (insert, delete, replace, swap of neighbours) from a to b."""
    rows = [list(range(len(b) + 1))]
    for i, x in enumerate(a, 1):
        row = [i]
        for j, y in enumerate(b, 1):
            best = min(rows[-1][j] + 1, row[-1] + 1, rows[-1][j - 1] + (x != y))
            if i > 1 and j > 1 and x == b[j - 2] and a[i - 2] == y:
                best = min(best, rows[-2][j - 2] + 1)
            row.append(best)
        rows.append(row)
    return rows[-1][-1]
