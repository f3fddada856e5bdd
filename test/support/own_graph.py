"""A ROS graph of a test's own, also while others run."""

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

# Above 101 the ports of a domain fall among those that Linux hands out to other programs.
ROS_DOMAINS = range(1, 102)


@contextmanager
def claimed_domain() -> Iterator[int]:
    """A ROS domain that no other test on this machine uses, across processes and sessions."""
    for domain in ROS_DOMAINS:
        path = Path(tempfile.gettempdir()) / f"longarm_ros_domain_{os.getuid()}_{domain}.lock"
        with path.open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    raise RuntimeError("every ROS domain is taken by a running test")


@contextmanager
def own_graph(folder: Path, freezes: bool = False) -> Iterator[int]:
    """Its domain, in the environment that processes inherit; logs in the folder.

    Its nodes find each other in half a second, not in up to three, and end as soon
    (`discovery.xml`).

    Args:
        freezes: whether a test stops a process for seconds. Fast DDS then takes its shared memory
            for that of a dead one and replaces it, so such a graph uses UDP alone.
    """
    with claimed_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        profile = str(Path(__file__).with_name("discovery.xml"))
        patch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", profile)
        if freezes:
            patch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
        patch.setenv("ROS_LOG_DIR", str(folder / "ros_log"))
        yield domain
