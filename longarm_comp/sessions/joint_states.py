"""Reads positions from serialised joint states without parsing each message.

A robot sends the same names in the same order a hundred times a second.  If the bytes before the
positions equal those of a message that was parsed, the positions are at the same offset.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.store import Typestore

from longarm_comp.sessions.message_types import stamp_of_raw

KIND = "sensor_msgs/msg/JointState"
_ENCODING, _STAMP = slice(0, 4), 12  # the header's stamp ends here

Numbers = tuple[float, ...]


class _Layout(NamedTuple):
    """Bytes before the positions, format of the positions, and which of them are the arm's."""

    encoding: bytes
    head: bytes
    begin: int
    numbers: struct.Struct
    pick: Callable[[Numbers], Numbers] | None


class JointStates:
    """Reads joint states of an arm."""

    def __init__(self, names: Sequence[str], types: Typestore) -> None:
        self._names, self._types = tuple(names), types
        self._layouts: list[_Layout] = []

    def __call__(self, raw: bytes) -> tuple[int, Numbers | None]:
        """Stamp (ns) and positions (n,) in the arm's order; None where one of its joints lacks."""
        return stamp_of_raw(raw), self._positions(raw)

    def _positions(self, raw: bytes) -> Numbers | None:
        for known in self._layouts:
            if raw[_STAMP : known.begin] == known.head and raw[_ENCODING] == known.encoding:
                if known.pick is None:
                    return None
                return known.pick(known.numbers.unpack_from(raw, known.begin))
        return self._parsed(raw)

    def _parsed(self, raw: bytes) -> Numbers | None:
        message: Any = self._types.deserialize_cdr(raw, KIND)
        place = {name: k for k, name in enumerate(message.name[: len(message.position)])}
        order = [place[name] for name in self._names if name in place]
        mine = len(order) == len(self._names)
        layout = self._layout(raw, message, _picker(order) if mine else None)
        if layout is not None:
            self._layouts = [layout, *self._layouts[: 8 - 1]]
        return tuple(float(message.position[k]) for k in order) if mine else None

    def _layout(
        self, raw: bytes, message: Any, pick: Callable[[Numbers], Numbers] | None
    ) -> _Layout | None:
        """Find the offset of the positions: serialise marks in their place and search them."""
        count = len(message.position)
        marks = 1.5 + np.arange(count)
        probe = dataclasses.replace(message, position=marks)
        written = bytes(self._types.serialize_cdr(probe, KIND))
        begin = written.find(marks.tobytes()) if count else -1
        if begin < 0 or written[_ENCODING] != raw[_ENCODING]:
            return None
        if written[_STAMP:begin] != raw[_STAMP:begin]:
            return None
        numbers = struct.Struct(f"<{count}d")
        return _Layout(bytes(raw[_ENCODING]), bytes(raw[_STAMP:begin]), begin, numbers, pick)


def _picker(order: list[int]) -> Callable[[Numbers], Numbers]:
    if len(order) == 1:
        return lambda values: (values[order[0]],)
    return itemgetter(*order)
