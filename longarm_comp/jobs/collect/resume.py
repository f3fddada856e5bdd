"""Which visits of a plan a bag holds, so that a collection goes on from there."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.errors import InputError
from longarm_comp.jobs.measurement_schedule import Visit
from longarm_comp.sessions.bag import open_bag
from longarm_comp.sessions.message_types import message_types

ROW_TOPIC, ROW_TYPE = "session_row", "std_msgs/msg/String"
_COMMAND_TOPIC = "joint_trajectory"
_READ = {ROW_TOPIC: ROW_TYPE, _COMMAND_TOPIC: "trajectory_msgs/msg/JointTrajectory"}


def visited(path: Path, todo: Sequence[Visit], n: int) -> set[int]:
    """Indices of the visits that a bag of an arm with n joints holds."""
    planned = {visit.index: visit.path for visit in todo}
    done: set[int] = set()
    command = np.zeros((0, n))
    with open_bag(path) as reader:
        kept = [c for c in reader.connections if _last_name(c.topic) in _READ]
        for connection, _, raw in reader.messages(connections=kept) if kept else ():
            name = _last_name(connection.topic)
            message: Any = message_types().deserialize_cdr(raw, _READ[name])
            try:
                if name == _COMMAND_TOPIC:
                    command = np.array([point.positions for point in message.points], float)
                    continue
                index = int(json.loads(message.data)["index"])
            except (KeyError, TypeError, ValueError) as error:
                allowed = "a bag that `longarm collect` began"
                raise InputError(path, connection.topic, str(error), allowed) from error
            way = planned.get(index)
            if way is None or command.shape != way.shape or np.abs(command - way).max() > SAME_POSE:
                allowed = "the plan, seed and options that it was begun with"
                raise InputError(path, f"visit {index}", command.tolist(), allowed)
            done.add(index)
    return done


def _last_name(topic: str) -> str:
    return topic.rpartition("/")[2]
