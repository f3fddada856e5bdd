"""Reads a session from any supported format."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.sessions.csv import read_csv, read_touches


def read_session(path: str | Path, arm: Arm) -> Session:
    """A CSV file, or a rosbag2: its folder or a ``.mcap`` or ``.db3`` file.

    ``touches.yaml`` beside it holds known distances of the points that it touched.

    Raises:
        InputError: it cannot be read in the format of its name.
    """
    path = Path(path)
    if path.is_dir() or path.suffix in (".mcap", ".db3"):
        from longarm_comp.sessions.bag import read_bag  # a CSV needs none of its libraries

        session = read_bag(path, arm)
    else:
        session = read_csv(path, arm)
    return dataclasses.replace(session, touch_distances=read_touches(path))
