"""Planning of the poses to measure."""

from __future__ import annotations

from typing import Literal

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import Plan, grid, sobol
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.next_poses import read_next_poses
from longarm_comp.workflows.inputs import FilePath

_PLANS = {"grid": grid, "sobol": sobol}


def plan(
    arm: Arm,
    n: int,
    *,
    kind: Literal["grid", "sobol"] = "sobol",
    seed: int = 0,
    report: FilePath | None = None,
) -> Plan:
    """n poses to measure an arm at, each with the side to approach it from.

    Args:
        arm: as declared.
        n: number of poses.
        kind: ``sobol`` fills the joint box evenly; ``grid`` draws from the paper's levels.
        seed: seed of the random choices.
        report: folder of a diagnosis. Its requested poses are used, whatever the kind.

    Returns:
        Joints `q` (n, joints) in rad and m, and the side `approach` (n,) of +1 or -1.

    Raises:
        InputError: n is out of range, no such kind, or the diagnosis asks for no poses.
    """
    if report is not None:
        return read_next_poses(report, arm, n)
    if kind not in _PLANS:
        raise InputError("plan", "kind", kind, ", ".join(_PLANS))
    return _PLANS[kind](arm, n, seed)
