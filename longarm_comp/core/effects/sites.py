"""Places that an arm has: what a `place` of an effect may be."""

from __future__ import annotations

from longarm_comp.core.arm.arm import Arm


def moving_joints(arm: Arm) -> list[int]:
    """Return the row ids of the joints that move, passive ones too."""
    return [joint.id for joint in arm.joints if joint.type != "fixed"]


GEARED = 2
"""Commanded joints that gears or rods couple are neighbours, or have one joint between them."""


def near(joint: int, other: int) -> bool:
    """Tell whether gears or rods may couple two commanded joints, by their numbers."""
    return 0 < abs(joint - other) <= GEARED


def rows(arm: Arm) -> list[int]:
    """Return the ids of all rows, base to tip."""
    return [joint.id for joint in arm.joints]


def frames(arm: Arm) -> list[int]:
    """Return the base (0) and the frame of every row."""
    return [0, *rows(arm)]


def beams(arm: Arm) -> list[str]:
    """Return the names of the declared beams."""
    return [beam.name for beam in arm.links]


def markers(arm: Arm) -> list[str]:
    """Return the names of the declared markers, after the empty one of the tip."""
    return ["", *arm.markers]
