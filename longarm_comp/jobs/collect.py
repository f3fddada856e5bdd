"""Runs a pose plan over the graph and records it: move, settle, look several times, next.

A visit enters the bag when it is complete, with a ``session_row`` message that says which it
was; so a session that was broken off anywhere is readable, and `collect` goes on from there.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.serialization import serialize_message
from std_msgs.msg import Float64, String

from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.data.rest_pose import JOINT_REST
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.measurement_schedule import Visit
from longarm_comp.jobs.progress import ProgressTeller
from longarm_comp.jobs.recorder import Recorder
from longarm_comp.sessions.bag import open_bag
from longarm_comp.sessions.bag_segments import SegmentedBag
from longarm_comp.sessions.message_types import message_types

ROW_TOPIC, ROW_TYPE = "session_row", "std_msgs/msg/String"
COMMAND_TOPIC = "joint_trajectory"
_READ = {ROW_TOPIC: ROW_TYPE, COMMAND_TOPIC: "trajectory_msgs/msg/JointTrajectory"}
_FRESH_S = 0.05  # a sighting shall be taken this long after the joints came to rest

_CIRCUMSTANCES_S = 5.0
"""Patience with the first temperature, payload and tilt. They come about once a second."""


@dataclass(frozen=True)
class Pace:
    """How long a visit may take.

    Attributes:
        sightings: averaged at each pose.
        dwell_s: the joints must rest so long before the first sighting counts.
        move_s: asked of the driver for each way-point; it keeps its own limits.
        arrive_s, look_s: patience with a move, and with the sightings.
        tolerance: rad or m between commanded and reported joints at rest.
    """

    sightings: int = 5
    dwell_s: float = 0.3
    move_s: float = 0.5
    arrive_s: float = 60.0
    look_s: float = 5.0
    tolerance: float = JOINT_REST

    def __post_init__(self) -> None:
        if self.sightings < 1:
            raise InputError("collect", "--sightings", self.sightings, "at least 1")


@dataclass(frozen=True)
class Collected:
    """What came of it: visits made now, made before, of all; and those without a sighting."""

    made: int
    before: int
    planned: int
    unseen: tuple[int, ...]


def collect(
    client: ArmClient,
    todo: Sequence[Visit],
    path: Path,
    *,
    pace: Pace | None = None,
    resume: bool = False,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Collected:
    """Visit every pose of a plan that the bag does not hold yet.

    Raises:
        InputError: the bag exists (without ``resume``), or belongs to another plan.
        JobError: the arm did not arrive, or never saw the marker.
        Interrupted: the client was stopped; the bag holds every complete visit.
    """
    pace = pace or Pace()
    done = visited(path, todo, client) if resume and (path / "metadata.yaml").is_file() else set()
    unseen: list[int] = []
    payload = client.node.create_publisher(Float64, "payload", 5)
    teller = ProgressTeller(client.node)
    with SegmentedBag(path, resume=resume) as bag:
        recorder = Recorder(client.node, bag)
        client.ready()
        _hear_circumstances(client, recorder)
        left = [visit for visit in todo if visit.index not in done]
        for k, visit in enumerate(left):
            progress(f"pose {visit.index}", k / len(left))
            teller.tell(len(done) + k, len(todo), f"at pose {visit.index}{_lost(unseen)}")
            recorder.drop()
            if visit.payload_kg is not None:
                payload.publish(Float64(data=visit.payload_kg))
            begun = time.time_ns()
            if not _visit(client, visit, pace):
                unseen.append(visit.index)
            _tell(client, recorder, visit)
            recorder.keep(since_ns=begun)
            if len(unseen) > max(5, len(left) // 2):
                raise JobError("the marker is not seen at most poses", lost=len(unseen))
        teller.tell(len(done) + len(left), len(todo), f"all poses visited{_lost(unseen)}")
    return Collected(len(left), len(done), len(todo), tuple(unseen))


def _lost(unseen: Sequence[int]) -> str:
    """In words, at how many poses the marker was not seen; nothing where it always was."""
    return f"; marker lost at {len(unseen)} poses" if unseen else ""


def _hear_circumstances(client: ArmClient, recorder: Recorder) -> None:
    """Wait a little for the first temperature, payload and tilt, where they are published."""
    end = time.monotonic() + _CIRCUMSTANCES_S
    client.until(
        lambda: not recorder.waits_for() or time.monotonic() > end,
        _CIRCUMSTANCES_S + 60.0, "circumstances",
    )  # fmt: skip


def _visit(client: ArmClient, visit: Visit, pace: Pace) -> int:
    """Drive to one pose and look; the number of sightings."""
    start = client.joints
    client.send(visit.path, pace.move_s)
    client.spin(0.05)  # the driver has taken it up when its joints move
    tolerance = np.full(client.arm.n, pace.tolerance)
    now = client.arrive(visit.path, tolerance, pace.dwell_s, pace.arrive_s, start)
    return len(client.look(now + int(_FRESH_S * 1e9), pace.sightings, pace.look_s))


def _tell(client: ArmClient, recorder: Recorder, visit: Visit) -> None:
    """Into the bag alone: what no topic of the robot says."""
    row = {"index": visit.index, "repeat_id": visit.repeat_id}
    topic = client.node.resolve_topic_name(ROW_TOPIC)
    recorder.put(topic, ROW_TYPE, serialize_message(String(data=json.dumps(row))))


def visited(path: Path, todo: Sequence[Visit], client: ArmClient) -> set[int]:
    """Indices of the visits that a bag holds.

    Raises:
        InputError: its poses, or the sides they were approached from, are not those of these
            visits.
    """
    planned = {visit.index: visit.path for visit in todo}
    done: set[int] = set()
    command = np.zeros((0, client.arm.n))
    with open_bag(path) as reader:
        kept = [c for c in reader.connections if _last_name(c.topic) in _READ]
        for connection, _, raw in reader.messages(connections=kept) if kept else ():
            name = _last_name(connection.topic)
            message: Any = message_types().deserialize_cdr(raw, _READ[name])
            if name == COMMAND_TOPIC:
                command = np.array([point.positions for point in message.points])
                continue
            index = int(json.loads(message.data)["index"])
            way = planned.get(index)
            if way is None or command.shape != way.shape or np.abs(command - way).max() > SAME_POSE:
                allowed = "the plan, seed and options that it was begun with"
                raise InputError(path, f"visit {index}", command.tolist(), allowed)
            done.add(index)
    return done


def _last_name(topic: str) -> str:
    return topic.rpartition("/")[2]
