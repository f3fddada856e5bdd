"""Plans the poses to measure."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import Vec3
from longarm_comp.core.data.plan import (
    Plan,
    fill_plan,
    grid,
    outside_boxes,
    paper_grid,
    sobol,
    with_floor,
)
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import read_stored
from longarm_comp.core.planning.optimal_poses import (
    POOL,
    Measure,
    Uncertainty,
    choose_optimal_poses,
    draw_touch_poses,
)
from longarm_comp.sessions.poses import read_next_poses
from longarm_comp.workflows import inputs

Kind = Literal["grid", "sobol", "next", "i-optimal", "d-optimal"]
_FILLING = {"grid": (grid, lambda arm: len(paper_grid(arm))), "sobol": (sobol, lambda arm: 2**20)}
"""By kind: a function that makes a plan, and one that returns the largest number of poses that it
can have."""
_OPTIMAL = ("i-optimal", "d-optimal")
NOISE = (3e-4, 1e-3)
"""Noise of a length (m) and an angle (rad) that is assumed before anything was measured."""


def plan(
    arm: Arm,
    n: int,
    *,
    kind: Kind | None = None,
    seed: int = 0,
    report: inputs.FilePath | None = None,
    model: inputs.ModelLike | None = None,
    measured: inputs.SessionLike | None = None,
    measure: Measure = "position",
    noise: tuple[float, float] = NOISE,
    floor: float | None = None,
    seen: Callable[[np.ndarray], np.ndarray] | None = None,
    points: Mapping[str, Vec3] | None = None,
    note: inputs.Note = inputs.log_note,
) -> Plan:
    """Plan n poses at which to measure an arm, each with the sides of arrival.

    Args:
        kind: ``sobol`` fills the joints' ranges evenly; ``grid`` draws from the paper's grid;
            ``next`` are the poses that the `report` asks for; ``i-optimal`` leaves the least
            expected error of the tip, ``d-optimal`` the least uncertainty of all parameters
            together (docs/collect.md). Default: ``next`` with a report, else ``sobol``.
        report: folder of a diagnosis; for an optimal kind its model and session are what is known.
        model: calibrated model, or its file: the arm is assumed to have its effects and no others.
            Without one it may have every effect of the library.
        measured: rows that were measured so far, for an optimal kind.
        measure: what each pose measures: ``position``, ``pose``, ``distance`` to every anchor, or
            ``touch`` of one of `points`, for an optimal kind.
        noise: noise of a length (m) and an angle (rad), if nothing was measured yet.
        floor: height (m, base frame) that the arm must stay above.
        seen: function that says which (M,) of the tip poses (M, 4, 4) the cameras see; others are
            left out.
        points: points to touch by name, and their rough places, m, base frame.
        note: called with each finding of the admission.

    Returns:
        Joints `q` (n, joints) in rad and m, and the side `approach` (n, joints) of +1 or -1; for
        an optimal kind, also the expected error of the tip (`OptimalPlan`).

    Raises:
        InputError: n is out of range, no such kind, or the diagnosis asks for no poses.
        JobError: the rows measured so far could not be fitted; too few poses are allowed.
    """
    within = arm if floor is None else with_floor(arm, floor)
    kind = kind or ("sobol" if report is None else "next")

    def allowed_poses(poses: Plan, where: Model) -> np.ndarray:
        free = outside_boxes(where, poses)
        return free if seen is None else free & seen(where.pose(poses.q))

    if kind == "i-optimal" or kind == "d-optimal":
        if report is not None:
            model = Path(report) / inputs.MODEL
            said = read_stored(model).provenance.get(inputs.SESSION)
            session = Path(report) / str(said)
            measured = measured or (session if said and session.exists() else None)
        known = inputs.choose_physics(arm, model)
        rows = None if measured is None else inputs.admit_session(measured, arm, known, note=note)
        pool = None
        if measure == "touch":
            rng = np.random.default_rng(seed)
            pool = draw_touch_poses(known, points or {}, max(POOL, 4 * n), rng)
        uncertain = Uncertainty.of(
            known, rows, measure, known=model is not None, sigma=noise, pool=pool
        )
        fitted = uncertain.model.arm.model_copy(update={"keep_out": within.keep_out})
        where = replace(uncertain.model, arm=fitted)
        return choose_optimal_poses(
            uncertain,
            n,
            criterion=kind,
            measure=measure,
            allowed=lambda poses: allowed_poses(poses, where),
            rng=seed,
            pool=pool,
        )
    if measured is not None or model is not None:
        raise InputError("plan", "kind", kind, f"{' or '.join(_OPTIMAL)}, with model or rows")
    where = declared_model(within)
    if (kind == "next") != (report is not None):
        only = "a diagnosis folder with --kind next, i-optimal or d-optimal, only"
        raise InputError("plan", "--report", report, only)
    if report is not None:
        asked = read_next_poses(report, arm, n)
        free = np.flatnonzero(allowed_poses(asked, where))
        if len(free) < len(asked):
            note(f"{len(asked) - len(free)} poses of the diagnosis are not allowed: left out")
        return asked.take(free)
    if kind not in _FILLING:
        raise InputError("plan", "kind", kind, ", ".join((*_FILLING, "next", *_OPTIMAL)))
    make, most = _FILLING[kind]
    if n < 1:
        raise InputError("plan", "n", n, f"1 to {most(arm)}")
    return fill_plan(make, arm, n, seed, lambda poses: allowed_poses(poses, where), most(arm))
