"""Images of one camera: heard as reliably as they are published, losses counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

from longarm_comp.nodes.interfaces import BEST_EFFORT, RELIABLE, Topic


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


class ImageInlet:
    """A subscription that follows its publishers.

    A reliable subscription hears no best-effort publisher, and says nothing of it.

    Args:
        reliable: whether nothing may be lost, where the publishers offer that.
    """

    def __init__(
        self, node: Node, topic: Topic, take: Callable[[Any], None], *, reliable: bool
    ) -> None:
        self._node, self._topic, self._take = node, topic, take
        self._reliable, self._watch = reliable, SequenceWatch()
        self._subscription: Any = None
        self._how: ReliabilityPolicy | None = None
        self.adapt()

    @property
    def lost(self) -> int:
        """Images that the middleware has lost or that a full queue has dropped."""
        return self._watch.lost

    @property
    def reliability(self) -> str:
        """How images are heard, in words."""
        return "reliable" if self._how is RELIABLE else "best effort"

    def adapt(self) -> None:
        """Subscribe again if the publishers that there are now cannot be heard as before."""
        name = self._node.resolve_topic_name(self._topic.name)
        ends = self._node.get_publishers_info_by_topic(name)
        offered = all(end.qos_profile.reliability is not BEST_EFFORT for end in ends)
        wanted = RELIABLE if self._reliable and offered else BEST_EFFORT
        if wanted is self._how:
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._how = wanted
        self._subscription = self._topic.subscription(self._node, self._hear, listens=wanted)

    def _hear(self, message: Any, info: Any) -> None:
        self._watch.taken([info["publication_sequence_number"] or 0], full=True)
        self._take(message)
