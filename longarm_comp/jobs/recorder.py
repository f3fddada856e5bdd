"""Recording of the graph's topics in a bag, as serialised messages."""

import threading
import time
from collections.abc import Sequence
from functools import partial

from rclpy.node import Node

from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.interfaces import Topic
from longarm_comp.sessions.bag import Message
from longarm_comp.sessions.bag_segments import SegmentedBag
from longarm_comp.sessions.message_types import moment, publisher_quality, stamp_of_raw

SESSION_TOPICS = (
    graph.TARGET_POSE,
    graph.JOINT_TRAJECTORY,
    graph.COMPENSATION,
    graph.JOINT_STATES,
    graph.PREDICTED_ERROR,
    graph.TIP_MEASURED,
    graph.TEMPERATURE,
    graph.PAYLOAD,
    graph.INCLINATION,
)
"""Topics of a session. Images would take a hundred times as much space."""

HELD_TOPICS = (graph.TEMPERATURE, graph.PAYLOAD, graph.INCLINATION)
"""Topics whose last message is valid until the next one, which may come much later."""

IMAGE_TOPICS = (graph.LEFT_IMAGE, graph.RIGHT_IMAGE, graph.LEFT_INFO, graph.RIGHT_INFO)

_DRAIN_S, _AT_ONCE = 5.0, 20
"""Longest time (s) to take in messages that have arrived at the end; callbacks between two checks
for more."""
_SEGMENT_S = 20.0
"""Length of a segment, s. A killed recorder loses at most one segment."""


class Recorder:
    """Subscribes to topics on a node and writes their messages to a bag.

    Messages wait in memory until `keep` makes them part of the recording; `drop` forgets them,
    but for the last one of each topic of `HELD_TOPICS`.
    """

    def __init__(
        self,
        node: Node,
        bag: SegmentedBag,
        topics: Sequence[Topic] = SESSION_TOPICS,
        segment_s: float = _SEGMENT_S,
    ) -> None:
        self._node, self._bag, self._segment_s = node, bag, segment_s
        self.waiting: list[Message] = []
        self._stamped: set[str] = set()
        self._held = {node.resolve_topic_name(topic.name) for topic in HELD_TOPICS}
        self._since = time.monotonic()
        self.counts: dict[str, int] = {}
        self.newest: dict[str, int] = {}
        """The latest time (ns) to which a message of each topic refers."""
        for topic in topics:
            name, message = node.resolve_topic_name(topic.name), topic.type
            kind = f"{message.__module__.split('.')[0]}/msg/{message.__name__}"
            if "header" in message.get_fields_and_field_types():
                self._stamped.add(name)
            bag.offers[name] = publisher_quality(topic.depth, latched=topic.latched)
            topic.subscription(node, partial(self.put, name, kind), depth=2000, raw=True)

    def put(self, topic: str, kind: str, raw: bytes) -> None:
        """Add a serialised message that was just received; ``topic`` is its full name."""
        received = time.time_ns()
        self.waiting.append((topic, kind, received, raw))
        self.newest[topic] = max(self.newest.get(topic, 0), self._find_moment(topic, received, raw))

    def keep(self, *, since_ns: int = 0, finish: bool = False) -> None:
        """Write the waiting messages that `about` returns, and forget all others.

        With `finish` the segment ends, so that they can be read at once.
        """
        for topic, kind, received, raw in self.about(since_ns):
            self._bag.write(topic, kind, received, raw)
            self.counts[topic] = self.counts.get(topic, 0) + 1
        self.waiting.clear()
        if finish or time.monotonic() - self._since > self._segment_s:
            self._bag.finish_segment()
            self._since = time.monotonic()

    def about(self, since_ns: int) -> list[Message]:
        """Return waiting messages stamped `since_ns` or later, and all of `HELD_TOPICS`."""
        return [
            entry
            for entry in self.waiting
            if entry[0] in self._held or self._find_moment(entry[0], entry[2], entry[3]) >= since_ns
        ]

    def _find_moment(self, topic: str, received: int, raw: bytes) -> int:
        """Return the time (ns) to which a message refers."""
        if topic not in self._stamped:
            return received
        return moment(stamp_of_raw(raw), received)

    def drop(self) -> None:
        last = {entry[0]: entry for entry in self.waiting if entry[0] in self._held}
        self.waiting = list(last.values())

    def waits_for(self) -> list[str]:
        """List the `HELD_TOPICS` that another node publishes, but of which no message has come."""
        silent, waits = self._held - {topic for topic, *_ in self.waiting} - set(self.counts), []
        for name in sorted(silent):
            publishers = self._node.get_publishers_info_by_topic(name)
            if any(each.node_name != self._node.get_name() for each in publishers):
                waits.append(name)
        return waits


def record(
    bag: SegmentedBag,
    topics: Sequence[Topic],
    stop: threading.Event,
    namespace: str = "",
    segment_s: float = _SEGMENT_S,
    duration_s: float | None = None,
) -> dict[str, int]:
    """Record until the event is set or the time is over; return the message counts by topic."""
    end = None if duration_s is None else time.monotonic() + duration_s
    with GraphClient(namespace, stop, "recorder") as client:
        recorder = Recorder(client.node, bag, topics, segment_s)
        try:
            while not stop.is_set() and (end is None or time.monotonic() < end):
                client.executor.spin_once(timeout_sec=0.1)
                recorder.keep()
            # Take what has arrived and was not taken yet
            by, before = time.monotonic() + _DRAIN_S, -1
            while len(recorder.waiting) > before and time.monotonic() < by:
                before = len(recorder.waiting)
                for _ in range(_AT_ONCE):
                    client.executor.spin_once(timeout_sec=0.0)
        finally:
            recorder.keep(finish=True)
    return recorder.counts
