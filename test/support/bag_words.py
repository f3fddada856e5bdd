"""Messages of words in a bag that is being written, and what its metadata say."""

from pathlib import Path

from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.sessions.bag_segments import SegmentedBag
from longarm_comp.sessions.message_types import message_types

TEXT = "std_msgs/msg/String"
START_NS = 10**18


def put_words(bag: SegmentedBag, topic: str, *words: str, first: int = 0) -> None:
    """Write them, a nanosecond apart, the first so many after `START_NS`."""
    types = message_types()
    for stamp, text in enumerate(words, START_NS + first):
        raw = types.serialize_cdr(types.types[TEXT](data=text), TEXT)
        bag.write(topic, TEXT, stamp, bytes(raw))


def offers(path: Path) -> dict[str, tuple[int, str, str]]:
    """Depth, reliability and durability by topic, as `ros2 bag play` reads them."""
    information = read_yaml(path / "metadata.yaml")["rosbag2_bagfile_information"]
    topics = [t["topic_metadata"] for t in information["topics_with_message_count"]]
    return {
        topic["name"]: (qos["depth"], qos["reliability"], qos["durability"])
        for topic in topics
        for qos in topic["offered_qos_profiles"]
    }
