"""One sighting as the recursive posterior reads it: a linear equation of the parameters."""

import math
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class Row:
    """One sighting, as a linear equation ``value = columns @ parameters + noise``."""

    t_s: float
    columns: np.ndarray  # (3, q) derivatives by the parameters, m per unit
    value: np.ndarray  # (3,) m, the sighting less the prediction with all parameters 0, linearised
    noise: np.ndarray  # (3, 3) covariance, m^2
    reach: float  # distance of the sighting from the base, m
    pose: np.ndarray | None = None  # (n,) joints, 0 to 1 over their ranges
    structure: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) m^2, covariance of the error that all visits to this pose have in common."""
    common: np.ndarray = field(default_factory=lambda: np.zeros((3, 0)))
    """(3, r) m, errors that all sightings share, each for one standard deviation of its cause."""
    anew: tuple[int, ...] = ()  # those of the r that begin anew with this sighting
    place: int = -1  # number of this pose among those whose own error is estimated; -1: none
    is_new: bool = False  # whether the error of this pose has not been estimated before

    def log_doubt(self, expected: np.ndarray) -> float:
        """Return the log density (1/m^3) of this sighting, given that it is wrong.

        A wrong sighting is off by any order of magnitude from the scatter to the reach, all equally
        likely.

        Args:
            expected: (q,) values of the parameters.
        """
        scatter = math.sqrt(float(np.trace(self.noise)))
        off = max(float(np.linalg.norm(self.value - self.columns @ expected)), scatter)
        orders = math.log(max(self.reach / scatter, math.e))
        return -math.log(4.0 * math.pi * orders) - 3.0 * math.log(off)
