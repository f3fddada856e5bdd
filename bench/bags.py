"""Benchmarks of bags: messages per second, written and read, and memory for a session of 1 GB.

The peers handle the same messages: `rosbags`, which this package stands on, as bare as it goes, and
the readers and writers that come with the mcap format for ROS 2.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader

from bench.arms import demo_arm
from bench.comparison import Result, beside, missing
from bench.subprocess_cost import cost_of
from bench.synthetic_bag import Raw, recording, write_raw
from longarm_comp.sessions.bag import read_bag
from longarm_comp.sessions.bag_segments import SegmentedBag
from longarm_comp.sessions.message_buffer import TYPES
from longarm_comp.sessions.message_types import message_types

MESSAGES, REPEATS = 40_000, 3
LONG_BYTES = 1_000_000_000
ROSBAGS = "rosbags, messages decoded"
MCAP = "mcap-ros2-support"


def _scratch() -> AbstractContextManager[str]:
    return tempfile.TemporaryDirectory(prefix="longarm_bench_")


def _rates(
    sides: tuple[Callable[[int], int], Callable[[int], int]], repeats: int
) -> list[np.ndarray]:
    """Messages per second of processor time of both sides, measured alternately."""
    per_second: tuple[list[float], list[float]] = ([], [])
    for turn in range(repeats):
        for rates, work in zip(per_second, sides, strict=True):
            begin = time.process_time()
            done = work(turn)
            rates.append(done / (time.process_time() - begin))
    return [np.array(rates) for rates in per_second]


# ------------------------------------------------------------------ reading


def count_decoded(path: Path) -> int:
    """Read and decode every message with the bare library."""
    types, count = message_types(), 0
    with Reader(path) as reader:
        for connection, _, raw in reader.messages(reader.connections):
            types.deserialize_cdr(raw, connection.msgtype)
            count += 1
    return count


def count_by_mcap(path: Path) -> int:
    """The same with `mcap-ros2-support`."""
    from mcap_ros2.reader import read_ros2_messages

    (file,) = path.glob("*.mcap")
    return sum(1 for _ in read_ros2_messages(str(file)))


def read(peer: str, count: int = MESSAGES, repeats: int = REPEATS) -> Result:
    """A robot's recording to a session, against decoding by ``rosbags`` or ``mcap`` alone."""
    said, theirs = {"rosbags": (ROSBAGS, count_decoded), "mcap": (MCAP, count_by_mcap)}[peer]
    if peer == "mcap" and find_spec("mcap_ros2") is None:
        return missing(MCAP, f"{MCAP} is not installed")
    arm = demo_arm()
    with _scratch() as scratch:
        path = Path(scratch) / "bag"
        write_raw(path, recording(arm), count)

        def ours(_: int) -> int:
            read_bag(path, arm)
            return count

        mine, other = _rates((ours, lambda _: theirs(path)), repeats)
    return beside("messages/s CPU", mine, said, other, more_is_better=True,
                  note="to a checked Session here, to decoded messages there")  # fmt: skip


# ------------------------------------------------------------------ writing


def _record_segments(path: Path, messages: list[Raw]) -> int:
    """Write messages as `longarm record` and `collect` do."""
    with SegmentedBag(path) as bag:
        for topic, stamp, data in messages:
            bag.write(f"/{topic}", TYPES[topic], stamp, data)
    return len(messages)


def record(count: int = MESSAGES, repeats: int = REPEATS) -> Result:
    """Recording of ROS messages in a bag that survives a kill, against the bare writer."""
    messages = list(islice(recording(demo_arm()), count))
    with _scratch() as scratch:
        mine, other = _rates(
            (
                lambda turn: _record_segments(Path(scratch) / f"a{turn}", messages),
                lambda turn: write_raw(Path(scratch) / f"b{turn}", iter(messages)),
            ),
            repeats,
        )
    peer = "rosbags writer"
    return beside("messages/s CPU", mine, peer, other, more_is_better=True)


# ------------------------------------------------------------------ a long session


def read_once(path: str) -> dict[str, float]:
    """Rows of a bag; run in a process of its own."""
    return {"rows": float(len(read_bag(Path(path), demo_arm())))}


def read_large(size: int = LONG_BYTES) -> Result:
    """Hours of recording to a session: memory that it takes beside the size of the bag."""
    arm = demo_arm()
    with _scratch() as scratch:
        free = shutil.disk_usage(scratch).free
        if free < 3 * size:
            return missing("the bag's own size", f"{free / 1e9:.1f} GB free on the disk")
        per_message = _bytes_per_message(Path(scratch) / "probe")
        costs = []
        for part in (size // 100, size):
            path = Path(scratch) / f"bag_{part}"
            count = write_raw(path, recording(arm), int(part / per_message))
            costs.append((count, cost_of(__name__, "read_once", str(path))))
            shutil.rmtree(path)
    (_, short), (count, long) = costs
    return beside(
        "MB grown",
        [long.grown_mb],
        "the bag's own size",
        [size / 1e6],
        note=f"{count} messages, {long.result['rows']:.0f} rows in {long.cpu_s:.0f} s; a bag of "
        f"a hundredth takes {short.grown_mb:.1f} MB",
        messages_per_s=count / long.cpu_s,
        peak_mb=long.peak_mb,
    )


def _bytes_per_message(path: Path) -> float:
    count = write_raw(path, recording(demo_arm()), 5_000)
    return sum(file.stat().st_size for file in path.iterdir()) / count
