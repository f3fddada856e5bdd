"""Checks of column names. The error for a misspelt name gives the most likely known one."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from difflib import get_close_matches

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
                allowed += _conversion(where, header)
            raise InputError(where, f"column {name}", f"missing{hint}", allowed)


def _conversion(where: str, header: Sequence[str]) -> str:
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

    Close: the same but for case, blanks and punctuation; without its unit (`temperature`); one
    letter wrong, or two of eight or more.  A column with any other name is kept as context.
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
    wrong = 2 if len(plain) >= 8 else 1
    spelt = {_plain(candidate): candidate for candidate in known}
    alike = [text for text in spelt if abs(len(text) - len(plain)) <= wrong and len(plain) >= 4]
    close = get_close_matches(plain, alike, 1, 1 - (wrong + 1e-9) / max(len(plain), 4))
    return spelt[close[0]] if close else None


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
