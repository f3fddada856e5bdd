"""Pairs left and right images by their stamps. Memory is bounded and drops are counted."""

from collections import Counter, deque
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

Image = TypeVar("Image")
_RESTART_NS = 1_000_000_000
"""A stamp that is earlier by more than this, ns, means a restarted clock, not a late image."""


class Drop(str, Enum):
    UNSYNCHRONISED = "no partner within the slop"
    OVERFLOW = "queue was full"
    OUT_OF_ORDER = "stamp older than, or equal to, an image already paired or dropped"
    RESTARTED = "clock jumped back; older images discarded"

    def __str__(self) -> str:
        return self.value


class Side(Enum):
    LEFT = 0
    RIGHT = 1


@dataclass(frozen=True)
class Pair(Generic[Image]):
    """Two images taken together. `stamp_ns` is the time stamp of the left one, ns."""

    stamp_ns: int
    left: Image
    right: Image


@dataclass
class StereoPairer(Generic[Image]):
    """Matches the images of two streams one to one by their stamps, oldest first.

    Two images are a pair if their stamps differ by at most `slop_ns` and no waiting image fits
    better. With `slop_ns` below half a frame period the pairing is unique.
    """

    slop_ns: int = 5_000_000  # largest difference of stamps within a pair, in nanoseconds
    queue: int = 8  # images kept per side while they wait for a partner
    drops: Counter[Drop] = field(default_factory=Counter)
    pairs: int = 0
    _waiting: tuple[deque[tuple[int, Image]], deque[tuple[int, Image]]] = field(
        default_factory=lambda: (deque(), deque()), repr=False
    )
    _done_ns: list[int | None] = field(default_factory=lambda: [None, None], repr=False)

    def add(self, side: Side, stamp_ns: int, image: Image) -> list[Pair[Image]]:
        """Add one image; return the pairs that it completes (usually none or one)."""
        mine = self._waiting[side.value]
        newest = mine[-1][0] if mine else self._done_ns[side.value]
        if newest is not None and stamp_ns <= newest:
            if newest - stamp_ns <= _RESTART_NS:
                self.drops[Drop.OUT_OF_ORDER] += 1
                return []
            for waiting in self._waiting:
                self.drops[Drop.RESTARTED] += len(waiting)
                waiting.clear()
            self._done_ns = [None, None]
        if len(mine) == self.queue:
            self._drop_older(side.value, Drop.OVERFLOW)
        mine.append((stamp_ns, image))
        left, right = self._waiting
        found: list[Pair[Image]] = []
        while left and right:
            apart = right[0][0] - left[0][0]
            if apart > self.slop_ns or self._next_is_nearer(left, right[0][0], apart):
                self._drop_older(Side.LEFT.value, Drop.UNSYNCHRONISED)
            elif -apart > self.slop_ns or self._next_is_nearer(right, left[0][0], apart):
                self._drop_older(Side.RIGHT.value, Drop.UNSYNCHRONISED)
            else:
                (stamp, left_image), (other, right_image) = left.popleft(), right.popleft()
                self._done_ns = [stamp, other]
                found.append(Pair(stamp, left_image, right_image))
        self.pairs += len(found)
        return found

    @staticmethod
    def _next_is_nearer(waiting: deque[tuple[int, Image]], partner_ns: int, apart: int) -> bool:
        return len(waiting) > 1 and abs(waiting[1][0] - partner_ns) < abs(apart)

    def _drop_older(self, side: int, why: Drop) -> None:
        self._done_ns[side] = self._waiting[side].popleft()[0]
        self.drops[why] += 1
