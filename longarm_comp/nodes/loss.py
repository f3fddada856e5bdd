"""Counts messages that a full queue of the middleware has lost.

The middleware reports what is lost on the way, but not what a full queue drops.
"""

from __future__ import annotations

import time


class SequenceWatch:
    """Finds gaps in the numbers that publishers give their messages.

    A message tells its number, not its publisher. Each number is taken to go on with the nearest
    one below it. Gaps count only where the queue was full: elsewhere they are a publisher that
    was heard for the first time.
    """

    def __init__(self) -> None:
        self._last: list[int] = []
        self.lost = 0

    def taken(self, numbers: list[int], *, full: bool) -> None:
        """Enter the numbers of messages taken from the queue at once, the oldest first.

        Args:
            numbers: as published, from 1 for each publisher.
            full: whether the queue may have been full.
        """
        for number in numbers:
            before = max((last for last in self._last if last < number), default=None)
            if before is None:
                self._last.append(number)
                continue
            self._last[self._last.index(before)] = number
            if full:
                self.lost += number - before - 1


class QueueWatch:
    """Finds the gaps where messages are taken one by one, as rclpy's executor does.

    Messages that had come before the first of them was taken were in the queue together. Where
    there are as many as it holds, it was full.

    Args:
        depth: messages that the queue holds.
    """

    def __init__(self, depth: int) -> None:
        self._watch, self._depth = SequenceWatch(), depth
        self._numbers: list[int] = []
        self._begun_ns = 0

    @property
    def lost(self) -> int:
        """Messages that were lost, as far as can be told."""
        return self._watch.lost

    def took(self, number: int, received_ns: int) -> None:
        """Enter a message that is taken now: its number, and when it came (system time, ns)."""
        if self._numbers and received_ns > self._begun_ns:
            self._end(full=False)
        if not self._numbers:
            self._begun_ns = time.time_ns()
        self._numbers.append(number)
        if len(self._numbers) == self._depth:
            self._end(full=self._depth > 1)

    def _end(self, *, full: bool) -> None:
        self._watch.taken(self._numbers, full=full)
        self._numbers = []
