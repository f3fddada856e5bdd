"""A plan as a CSV file (poses.csv): ``index,approach,q1..qn[,payload_kg][,touch]``.

If the joints of a pose arrive from different sides, ``approach_q1..qn`` replace ``approach``.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.circumstances import check_circumstance
from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.data.plan import Plan
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.csv import (
    approach_names,
    joint_names,
    make_approach_columns,
    read_approach,
)
from longarm_comp.sessions.table import WriteTable, check_header, read_table, write_table

FILE = "next_poses.csv"


def read_next_poses(folder: str | Path, arm: Arm, n: int) -> Plan:
    """Read the first n poses of a diagnosis' ``next_poses.csv``, most informative first.

    Raises InputError if the diagnosis asks for fewer, or for none.
    """
    path = Path(folder) / FILE
    if not path.is_file():
        raise InputError(path, "file", "missing", "a diagnosis that asks for poses writes it")
    plan = read_poses(path, arm)
    if not 1 <= n <= len(plan):
        raise InputError("plan", "n", n, f"1 to {len(plan)} (poses of the diagnosis)")
    return plan.take(np.arange(n))


def write_poses(plan: Plan, path: str | Path, write: WriteTable = write_table) -> None:
    """Write a plan, whole or not at all; ``write`` may be a writer of another table format."""
    columns: dict[str, Sequence[object] | np.ndarray] = {
        "index": range(len(plan)),
        **make_approach_columns(plan.approach),
        **{name: plan.q[:, j] for j, name in enumerate(joint_names(plan.q.shape[1]))},
    }
    if plan.payload_kg is not None:
        columns["payload_kg"] = plan.payload_kg
    if plan.touch is not None:
        columns["touch"] = plan.touch
    write(path, list(columns), zip(*columns.values(), strict=True))


def read_poses(path: str | Path, arm: Arm, *, inside: bool = True) -> Plan:
    """Read a plan. A blank or 0 approach means any side.

    Args:
        inside: refuse poses outside the joint limits.

    Raises:
        InputError: a column is missing or not known, or a cell is wrong.
    """
    table = read_table(path)
    joints = joint_names(arm.n)
    known = ("index", "approach", "payload_kg", "touch", *approach_names(arm.n), *joints)
    check_header(table.where, table.header, joints)
    for name in table.header:
        if name not in known:
            raise InputError(table.where, f"column {name}", "unknown", " ".join(known))
    q = table.block(joints, "rad or m")
    outside = (q < arm.lower - SAME_POSE) | (q > arm.upper + SAME_POSE)
    for row, j in zip(*np.nonzero(outside & inside), strict=True):
        limits = f"{arm.lower[j]:.6g} to {arm.upper[j]:.6g} (limits of {arm.joint_names[j]})"
        raise table.error(row, joints[j], limits)
    approach = read_approach(table, arm.n)
    payload = table.numbers("payload_kg", "kg") if "payload_kg" in table.cells else None
    if payload is not None:
        check_circumstance(arm, "payload_kg", payload, table.where)
    on_limit = np.where(outside, q, np.clip(q, arm.lower, arm.upper))
    touch = np.array(table.cells["touch"]) if "touch" in table.cells else None
    return Plan(on_limit, approach, payload, touch)
