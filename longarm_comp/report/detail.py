"""Data of the page beyond report.json, in m and rad; error = measured - predicted.

All parts are optional: a verdict of noise has no guilty input, one of bad_data no rows.
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
    """One input of the rows, as report.json calls it (``q2``, ``approach``); `values` (N,)."""

    name: str
    unit: str
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class SeenRows:
    """Held-out rows of a session whose marker was seen.

    Attributes:
        index: (N,) row numbers in the session.
        measured_m: (N, 3) tip.
        errors_m: (N, 3) measured - predicted by stage (one of `STAGES`).
        inputs: joints first.
        arms_m: centre-lines (K, 3), base to tip, at a few of these rows.
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
    """Posterior correlation (p, g) of the accepted parameters with geometry, both by label."""

    parameters: tuple[str, ...]
    geometry: tuple[str, ...]
    matrix: np.ndarray


@dataclass(frozen=True)
class Detectable:
    """The smallest size of an effect that these data would have shown, and its RMS at the tip.

    None where no size would show: the data do not excite it.
    """

    effect: str
    where: str
    parameter: str
    size: float | None
    unit: str
    size_mm: float | None


@dataclass(frozen=True, eq=False)
class SetSplit:
    """Effects that these data cannot distinguish, and poses (M, n) that would.

    `sides`: (M,) from below (+1), above (-1) or anywhere (0). `expected_log_bayes_factor`: between
    the two closest members after measuring the poses.
    """

    members: tuple[str, ...]
    reason: str = ""
    q: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    sides: tuple[int, ...] = ()
    expected_log_bayes_factor: float | None = None


@dataclass(frozen=True)
class EncoderError:
    """Reading - command of a joint over the fitted rows, in `unit` (mrad or mm).

    `rms` is the spread about the mean, `left` the RMS that the model leaves.
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
        damping: share of critical damping; `declared`: arm.yaml says it.
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
    """The centre-line (K, 3) of the arm in one posture, and the points (3,) of a finding."""

    arm_m: np.ndarray
    places_m: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Detail:
    """Everything the page draws beyond report.json.

    Attributes:
        before, after: the stages that the verdict compares.
        guilty: inputs that the findings, or the structure left, depend on; the worst first.
        rings: None where nothing of the model bends.
        marked: where each finding is on the arm, in the order of the cards.
        provenance: further facts, shown after those of report.json.
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
