"""Lists of the places on an arm: the allowed values of an effect's `place` fields."""

from longarm_comp.core.arm.arm import Arm


def moving_joints(arm: Arm) -> list[int]:
    """Return the row ids of all joints that are not fixed, including passive ones."""
    return [joint.id for joint in arm.joints if joint.type != "fixed"]


GEARED = 2
"""Largest difference of the numbers of two commanded joints that gears or rods may couple.

They are neighbours, or have one joint between them.
"""


def near(joint: int, other: int) -> bool:
    """Tell whether gears or rods may couple two commanded joints, given their numbers."""
    return 0 < abs(joint - other) <= GEARED


def rows(arm: Arm) -> list[int]:
    """Return the ids of all rows, base to tip."""
    return [joint.id for joint in arm.joints]


def frames(arm: Arm) -> list[int]:
    """Return 0 for the base frame, and the ids of all rows for their frames."""
    return [0, *rows(arm)]


def beams(arm: Arm) -> list[str]:
    """Return the names of the declared beams."""
    return [beam.name for beam in arm.links]


def markers(arm: Arm) -> list[str]:
    """Return "" (the tip) and the names of the declared markers."""
    return ["", *arm.markers]
