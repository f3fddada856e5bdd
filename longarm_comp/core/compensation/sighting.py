"""Computes how far a sighting may be from its prediction: by the command, and by the sensor.

The sum is that of `compensate.judge`.  Here its parts are separate, because they repeat in
different ways.  An error that all sightings share tells no more in a hundred of them than in one,
so whoever learns from sightings, or tests them, must follow it as a state.
"""

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.beyond import list_beyond, outside_data
from longarm_comp.core.compensation.expected import expected_miss, spread_of
from longarm_comp.core.compensation.unknown import moved_by_payload, unknown_history
from longarm_comp.core.compensation.unshown import unshown_effects
from longarm_comp.core.compensation.weighing import SD
from longarm_comp.core.model.domain import least_moved
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.uncertainty import ModelUncertainty, factor_of

_BEYOND = {"temperature_c": 3, "payload_kg": 4}
"""Column of `SightingError.common` by the circumstance that no row had."""
_TILT, PAYLOAD, COMMON = 5, 6, 7
"""The column of every tilt, because the same compliances answer to them; that of a payload which is
known to its standard deviation only; and the number of columns. The first three are the frame's."""
VISITED, ALIKE = 16, 0.05
"""Number of poses, the last ones, whose own errors are followed; and the share of its range by
which every joint of two poses may differ if they are to count as one."""
SHARED = 0.5
"""Variance of the error that is the same at each visit to a pose, as a share of the variance that
no parameter explains. The full variance counts as noise besides: friction, for instance, differs
from visit to visit."""
_Visited = tuple[tuple[int, np.ndarray], ...]


@dataclass(frozen=True, eq=False)
class SightingError:
    """The error of one sighting, without the error of the model's parameters."""

    noise: np.ndarray  # (3, 3) m^2, covariance of the part that is independent at each sighting
    structure: np.ndarray  # (3, 3) m^2, of the part that all visits to these joints share
    common: np.ndarray
    """(3, COMMON) m, the parts that all sightings share, each for one standard deviation of its
    cause."""

    @property
    def covariance(self) -> np.ndarray:
        """The covariance (3, 3) of a single sighting, m^2."""
        return np.asarray(self.noise + self.structure + self.common @ self.common.T)


def error_of_sighting(
    model: Model,
    promised: ModelUncertainty,
    q: np.ndarray,
    context: Context,
    variance: np.ndarray,
    learned: np.ndarray | None = None,
) -> SightingError:
    """Return the error of a sighting of an arm at rest.

    Args:
        model: the model that predicts it.
        promised: the uncertainty of that model before any sighting.
        q: (n,) commanded joints, rad and m.
        context: circumstances, with the history of the joints.
        variance: (3,) m^2, variance of the measurement along each axis.
        learned: (3,) m, sigma of the error that a predictor corrects. It replaces the structure. It
            contains the parameters' error too, so this is counted twice.
    """
    here = q[None]
    (unknown,), _ = unknown_history(model, here, context)
    (outside,), _ = outside_data(model, here, context)
    if learned is None:
        # without the bound of a promise by usual sizes: an unusual error is no change
        (structure,) = promised.structure_at(here, least_moved(model.arm))
        if promised.alternatives:  # each errs alike at each visit
            miss = expected_miss(model, q, context, np.zeros(3))
            structure = structure + spread_of(miss.chance, miss.apart, miss.further)
    else:
        structure = np.diag(np.maximum(learned**2 - np.diag(promised.noise), 0.0))
    structure = structure + np.diag(outside**2) + unshown_effects(model, here, context)[0][0]
    common = np.zeros((3, COMMON))
    common[:, :3] = factor_of(promised.frame)
    for beyond in list_beyond(model, here, context):
        common[:, _BEYOND.get(beyond.name, _TILT)] += beyond.change[0]
        structure += np.diag(beyond.rest[0])  # by effects of unknown form
    common[:, PAYLOAD] = moved_by_payload(model, here, context)[0]
    noise = np.maximum(promised.noise, np.diag(variance)) + np.diag(unknown**2)
    return SightingError(noise, structure, common)


def is_other_payload(before_kg: float, context: Context) -> bool:
    """Tell whether a payload differs from the last one by more than its own uncertainty.

    It was then weighed anew, so its error is another one.
    """
    sd = float(context.columns.get(SD, 0.0))
    return abs(float(context.payload_kg(0.0)) - before_kg) > 2.0 * sd


def visit(visited: _Visited, pose: np.ndarray) -> tuple[int, bool, _Visited]:
    """Find the number of a pose in the list of visited poses.

    If all numbers are in use, a new pose takes that of the pose visited longest ago.

    Args:
        visited: number and joints of each pose in the list, the last visited one last.
        pose: (n,) joints, 0 to 1 over their ranges.

    Returns:
        The number, whether the pose is new, and the new list.
    """
    for known in visited:
        if np.abs(known[1] - pose).max() < ALIKE:
            others = tuple(each for each in visited if each is not known)
            return known[0], False, (*others, known)
    full = len(visited) == VISITED
    place = visited[0][0] if full else len(visited)
    return place, True, (*visited[full:], (place, pose))
