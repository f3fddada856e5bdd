"""Planning of the poses to measure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.allowed_poses import in_view, outside_boxes
from longarm_comp.core.data.plan import Plan, grid, sobol
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.optimal_poses import Measure, Uncertainty, optimal_poses
from longarm_comp.core.model.model_file import read_stored
from longarm_comp.sessions.next_poses import read_next_poses
from longarm_comp.workflows.diagnosis_files import MODEL, SESSION
from longarm_comp.workflows.inputs import (
    FilePath,
    ModelLike,
    Note,
    SessionLike,
    admitted,
    log_note,
    physics,
)

Kind = Literal["grid", "sobol", "i-optimal", "d-optimal"]
_FILLING = {"grid": grid, "sobol": sobol}
_OPTIMAL = ("i-optimal", "d-optimal")
NOISE = (3e-4, 1e-3)
"""Noise of a length (m) and an angle (rad) where nothing was measured yet."""


def plan(
    arm: Arm,
    n: int,
    *,
    kind: Kind = "sobol",
    seed: int = 0,
    report: FilePath | None = None,
    model: ModelLike | None = None,
    measured: SessionLike | None = None,
    measure: Measure = "position",
    noise: tuple[float, float] = NOISE,
    view_deg: float | None = None,
    keep_out: Sequence[Sequence[float]] = (),
    note: Note = log_note,
) -> Plan:
    """n poses to measure an arm at, each with the side to approach it from.

    Args:
        arm: as declared.
        n: number of poses.
        kind: ``sobol`` fills the joint box evenly; ``grid`` draws from the paper's levels;
            ``i-optimal`` leaves the least expected error of the tip, ``d-optimal`` the least
            volume of all parameters (docs/studies.md).
        seed: seed of the random choices.
        report: folder of a diagnosis. Its requested poses are used, whatever the kind; for an
            optimal kind its model and session are what is known.
        model: calibrated model, or its file: the arm has its effects and no others. Without one
            every effect of the library may be there.
        measured: rows that were measured so far, for an optimal kind.
        measure: what each pose measures: ``position``, ``pose``, or ``distance`` to every anchor.
        noise: of a length (m) and an angle (rad), where nothing was measured yet.
        view_deg: half of the view of the cameras in arm.yaml; the tip must be in it.
        keep_out: boxes that the arm must not enter: x, y, z of two corners each, m, in the frame
            of the measurements.
        note: called with each finding of the admission.

    Returns:
        Joints `q` (n, joints) in rad and m, and the side `approach` (n, joints) of +1 or -1; for
        an optimal kind, also the error of the tip that is expected (`OptimalPlan`).

    Raises:
        InputError: n is out of range, no such kind, or the diagnosis asks for no poses.
        JobError: the rows measured so far could not be fitted.
    """
    if kind == "i-optimal" or kind == "d-optimal":
        if report is not None:
            model, measured = Path(report) / MODEL, measured or _session_of(report)
        known = physics(arm, model)
        rows = None if measured is None else admitted(measured, arm, known, note=note)
        uncertain = Uncertainty.of(known, rows, measure, known=model is not None, sigma=noise)
        boxes = [_box(box) for box in keep_out]

        def allowed(poses: Plan) -> np.ndarray:
            free = outside_boxes(uncertain.model, poses, boxes)
            if view_deg is None:
                return free
            return free & in_view(uncertain.model, poses, math.radians(view_deg))

        return optimal_poses(
            uncertain, n, criterion=kind, measure=measure, allowed=allowed, rng=seed
        )
    if keep_out or view_deg is not None or measured is not None or model is not None:
        allowed_kinds = " or ".join(_OPTIMAL)
        raise InputError("plan", "kind", kind, f"{allowed_kinds}, with model, rows, view or boxes")
    if report is not None:
        return read_next_poses(report, arm, n)
    if kind not in _FILLING:
        raise InputError("plan", "kind", kind, ", ".join((*_FILLING, *_OPTIMAL)))
    return _FILLING[kind](arm, n, seed)


def _session_of(report: FilePath) -> Path | None:
    """The session that a diagnosis was made of, where it is still there."""
    said = read_stored(Path(report) / MODEL).provenance.get(SESSION)
    path = Path(report) / str(said)
    return path if said and path.exists() else None


def _box(given: Sequence[float]) -> np.ndarray:
    box = np.array(given, dtype=float).reshape(-1)
    if box.shape != (6,) or not np.isfinite(box).all():
        raise InputError("plan", "keep_out", list(given), "x, y, z of two corners (m)")
    return box.reshape(2, 3)
