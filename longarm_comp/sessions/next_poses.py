"""Reads the poses that a diagnosis requests from its folder."""

from __future__ import annotations

from pathlib import Path

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import Plan
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.poses import read_poses

FILE = "next_poses.csv"


def read_next_poses(folder: str | Path, arm: Arm, n: int) -> Plan:
    """The first n poses of a diagnosis' ``next_poses.csv``, most informative first."""
    path = Path(folder) / FILE
    if not path.is_file():
        raise InputError(path, "file", "missing", "a diagnosis that asks for poses writes it")
    plan = read_poses(path, arm)
    if not 1 <= n <= len(plan):
        raise InputError("plan", "n", n, f"1 to {len(plan)} (poses of the diagnosis)")
    payload = None if plan.payload_kg is None else plan.payload_kg[:n]
    return Plan(plan.q[:n], plan.approach[:n], payload)
