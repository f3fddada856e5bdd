"""Counts messages that a full queue of the middleware has lost.

The middleware reports what is lost on the way, but not what a full queue drops.
"""

from __future__ import annotations


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
