"""How long a measurement on the graph may take."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.data.rest import JOINT_REST
from longarm_comp.core.errors import InputError


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
