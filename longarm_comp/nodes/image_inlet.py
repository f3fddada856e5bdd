"""Images of one camera: heard as reliably as they are published, losses counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

from longarm_comp.nodes.interfaces import BEST_EFFORT, RELIABLE, Topic
from longarm_comp.nodes.loss import SequenceWatch


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
