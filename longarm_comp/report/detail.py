"""Data of the page beyond report.json, as plain arrays and strings.

All parts are optional: a verdict of noise has no guilty input, one of bad_data no rows.
Lengths are in m, angles in rad. Sign: error = measured - predicted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

STAGES = (
    *("nominal", "frames_only", "calibrated"),
    *("with_effects", "with_functions", "with_network"),
)
"""The models of the before/after table, in the order in which they are built."""


@dataclass(frozen=True, eq=False)
class Input:
    """One input of the rows: a joint, the approach, a context column.

    Attributes:
        name: as the session and report.json call it (``q2``, ``approach``, ``temperature_c``).
        unit: of the values (``rad``, ``m``, ``s``), empty where there is none.
        values: (N,) in the order of the rows.
    """

    name: str
    unit: str
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class SeenRows:
    """Held-out rows of a session whose marker was seen.

    Attributes:
        index: (N,) row numbers in the session.
        measured_m: (N, 3) tip.
        errors_m: stage (one of `STAGES`) -> (N, 3) measured - predicted.
        inputs: every input of the rows, joints first.
        arms_m: centre-lines of the arm at a few of these rows, (K, 3) each, base to tip.
    """

    index: np.ndarray
    measured_m: np.ndarray
    errors_m: Mapping[str, np.ndarray]
    inputs: tuple[Input, ...] = ()
    arms_m: tuple[np.ndarray, ...] = ()

    def input(self, name: str) -> Input:
        """The input of that name."""
        return next(entry for entry in self.inputs if entry.name == name)


@dataclass(frozen=True, eq=False)
class Correlation:
    """Posterior correlation of accepted parameters (rows) with geometry (columns).

    Attributes:
        parameters: (p,) labels, such as ``joint_compliance joint 2``.
        geometry: (g,) labels, such as ``dh_error joint 2 a``.
        matrix: (p, g), -1 to 1.
    """

    parameters: tuple[str, ...]
    geometry: tuple[str, ...]
    matrix: np.ndarray


@dataclass(frozen=True)
class Detectable:
    """The smallest size of an effect that these data would have shown.

    Attributes:
        effect, where: canonical name and place, as among the candidates.
        parameter: which parameter the size is of.
        size: in `unit`; None where no size could be seen (the data do not excite it).
        unit: of `size`.
        size_mm: what that size moves the tip by, root mean square over the rows; None as `size`.
    """

    effect: str
    where: str
    parameter: str
    size: float | None
    unit: str
    size_mm: float | None


@dataclass(frozen=True, eq=False)
class SetSplit:
    """Effects that these data cannot distinguish, and poses that would.

    Attributes:
        members: the names in the set, as the finding lists them.
        reason: why they look alike in these data.
        q: (M, n) poses to measure, rad and m; none if no pose distinguishes them.
        sides: (M,) from below (+1), above (-1) or anywhere (0).
        expected_log_bayes_factor: between the two closest members after measuring the poses.
    """

    members: tuple[str, ...]
    reason: str = ""
    q: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    sides: tuple[int, ...] = ()
    expected_log_bayes_factor: float | None = None


@dataclass(frozen=True)
class EncoderError:
    """What the readings of a joint said, over the rows that were fitted; mrad or mm.

    Attributes:
        joint: its name.
        unit: ``mrad`` or ``mm``.
        mean, rms, most: of reading - command: mean, spread about it, largest distance from it.
        left: rms that the model leaves of it.
        noise: of the encoder.
    """

    joint: str
    unit: str
    mean: float
    rms: float
    most: float
    left: float
    noise: float


@dataclass(frozen=True)
class Rings:
    """How the arm rings, its drives held.

    Attributes:
        damping: share of critical damping. declared: whether arm.yaml says it.
        move_s: time of a straight move there from the posture before.
        postures: of each in words, Hz of the slowest mode of the arm as declared (None: nothing
            bends) and of the model that was written, and s until the tip stays within 0.1 mm.
    """

    damping: float
    declared: bool
    move_s: float
    postures: tuple[tuple[str, float | None, float, float], ...]


@dataclass(frozen=True, eq=False)
class Marked:
    """The arm in one posture, with the places of a finding.

    Attributes:
        arm_m: (K, 3) centre-line, base to tip.
        places_m: place in words -> (3,) point.
    """

    arm_m: np.ndarray
    places_m: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Detail:
    """Everything the page draws beyond report.json.

    Attributes:
        title: what was diagnosed, such as the session's name.
        joints: names of the commanded joints, in order.
        joint_units: ``rad`` or ``m``, in order.
        held_out: rows with their errors.
        before, after: the stages that the verdict compares.
        guilty: inputs that the findings, or the structure left, depend on; the worst first.
        correlation: of the accepted parameters with geometry.
        detectable: smallest visible size per effect.
        splits: sets with the poses that split them.
        encoders: of the joints that were read.
        rings: None where nothing of the model bends.
        marked: where each finding is on the arm, in the order of the cards.
        provenance: further facts, name -> value, shown after those of report.json.
    """

    title: str = "Diagnosis"
    joints: tuple[str, ...] = ()
    joint_units: tuple[str, ...] = ()
    held_out: SeenRows | None = None
    before: str = "calibrated"
    after: str = "with_effects"
    guilty: tuple[str, ...] = ()
    correlation: Correlation | None = None
    detectable: tuple[Detectable, ...] = ()
    splits: tuple[SetSplit, ...] = ()
    encoders: tuple[EncoderError, ...] = ()
    rings: Rings | None = None
    marked: tuple[Marked, ...] = ()
    provenance: Mapping[str, str] = field(default_factory=dict)
