"""Calibration of the same parameters on the same data with other libraries."""

from __future__ import annotations

import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from bench.peer_environment import python_of
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.model_fit import prior_widths
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.model import Model

PYBOTICS = ("pybotics==3.1.2",)


@dataclass(frozen=True)
class Calibrated:
    """Result of a peer."""

    seconds: float
    held_out_mm: float
    parameters: int


def by_finite_differences(model: Model, session: Session, sigma: float) -> Model:
    """SciPy's ``least_squares`` (trf, 2-point) on the same posterior: residuals and priors."""
    scale, context = prior_widths(model.slots), session.context()

    def residual(u: np.ndarray) -> np.ndarray:
        predicted = model.with_values(u * scale).measured(session.q, context)
        return np.concatenate([((session.xyz - predicted) / sigma).ravel(), u])

    found = least_squares(residual, model.values / scale)
    return model.with_values(found.x * scale)


def pybotics(arm: Arm, session: Session, held_out: Session) -> Calibrated:
    """Rigid calibration as in pybotics's own example: DH rows beyond the first, the world's pose.

    Raises:
        JobError: it cannot be installed, or it failed.
    """
    joints = arm.joints
    rows = [(np.radians(j.alpha_deg), j.a_m, np.radians(j.theta_offset_deg), j.d_m) for j in joints]
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data.npz"
        np.savez(
            data,
            rows=np.array(rows),
            prismatic=np.array([j.type == "prismatic" for j in joints]),
            tip=np.array(arm.tip.position_m),
            q=session.q,
            xyz=session.xyz,
            held_q=held_out.q,
            held_xyz=held_out.xyz,
        )
        worker = Path(__file__).with_name("pybotics_worker.py")
        done = subprocess.run(
            [str(python_of("pybotics", PYBOTICS)), str(worker)],
            input=json.dumps({"data": str(data)}) + "\n",
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode != 0:
        raise JobError(f"pybotics ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    answer = json.loads(done.stdout)
    return Calibrated(answer["seconds"], answer["held_out_mm"], answer["p"])
