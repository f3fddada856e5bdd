"""`touches.yaml`: known distances between the points that the session beside it touched."""

from __future__ import annotations

from pathlib import Path

import yaml

from longarm_comp.core.arm.measuring import KnownDistance, Touches, known_distances
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import atomic_path
from longarm_comp.core.yaml_file import parse_declared, read_yaml

NAME = "touches.yaml"


def read_touches(session: Path) -> tuple[KnownDistance, ...]:
    """What the file in a bag's folder, or beside a session, says; nothing where there is none."""
    for folder in (session, session.parent):
        path = folder / NAME
        if path.is_file():
            declared = parse_declared(Touches, read_yaml(path), str(path))
            return known_distances(declared.touch_distances)
    return ()


def write_touches(distances: tuple[KnownDistance, ...], folder: Path) -> None:
    """Write the file, where there are distances."""
    path = folder / NAME
    if not distances:
        return
    if path.is_file() and read_touches(path) != distances:
        raise InputError(str(path), "touch_distances", "other ones", "another folder")
    with atomic_path(path) as partial:
        known = yaml.safe_dump({"touch_distances": [list(d) for d in distances]}, sort_keys=False)
        partial.write_text(known, encoding="utf-8")
