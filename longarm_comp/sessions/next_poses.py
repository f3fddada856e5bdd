"""The poses that a diagnosis asks for, from its report.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from longarm_comp.core.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.plan import Plan


def read_next_poses(folder: str | Path, arm: Arm, n: int) -> Plan:
    """The first n of ``next_poses``, most telling first, approached from alternating sides.

    Raises:
        InputError: no report, none asked for, fewer than n, or joints of another arm.
    """
    path = Path(folder) / "report.json"
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        poses = np.array(report["next_poses"], dtype=float)
    except OSError as error:
        raise InputError(
            path, "file", error.strerror or str(error), "a diagnosis report"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(path, "next_poses", str(error), "rows of joints") from error
    if poses.ndim != 2 or poses.shape[1] != arm.n or not np.isfinite(poses).all():
        allowed = f"rows of {arm.n} finite joints"
        raise InputError(path, "next_poses", f"shape {poses.shape}", allowed)
    if ((poses < arm.lower - 1e-9) | (poses > arm.upper + 1e-9)).any():
        raise InputError(path, "next_poses", "outside", f"the joint limits of arm {arm.name}")
    if not 1 <= n <= len(poses):
        raise InputError("plan", "n", n, f"1 to {len(poses)} (poses of the report)")
    return Plan(np.clip(poses[:n], arm.lower, arm.upper), np.where(np.arange(n) % 2, -1, 1))
