"""Reports that sentences are checked on: diagnoses of simulated and measured arms, drawn anew.

What a sentence may speak of (errors, findings, structure, noise, network) is replaced by drawn
values: sentences are about numbers, whatever these are.
"""

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from hidden_arm import at, session, white
from places import EXAMPLES
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraDrift
from longarm_comp.core.effects.compliances import BearingTilt, JointCompliance, ServoDroop
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.plays import Backlash, ServoDeadband
from longarm_comp.core.effects.slow_changes import BaseSettling
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.findings import Finding, RunnerUp
from longarm_comp.sessions.csv import read_csv
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import drives, loads
from studies import real_sessions

TOUCHED = EXAMPLES / "panda_touch"
AT_JOINTS = (JointGain, GearEccentricity, Backlash, ServoDeadband)
CALLED = ("slew", "luff", "extend", "knuckle")


@cache
def in_doubt() -> Diagnosis:
    """A joint that gives way, or its servo: a set; the joints have names.

    Of a payload of 0.5 kg calibration leaves 0.04 mm of it, which needs no name.
    """
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    rows = [row | {"name": name} for row, name in zip(data["joints"], CALLED, strict=True)]
    load = {"frame": 4, "position_m": [0.0, 0.0, 0.05], "mass_kg": 2.0}
    arm = Arm.parse({**data, "joints": rows, "payload": load}, "boom")
    rng = np.random.default_rng(3)
    q = arm.lower + rng.random((150, arm.n)) * (arm.upper - arm.lower)
    real = TrueArm(arm, (loads.JointCompliance(at(2, 4e-3)),))
    kinds = (JointCompliance, ServoDroop, BearingTilt, JointGain)
    return diagnose(arm, Session.record(q, real.tip(q) + white(rng, len(q))), kinds=kinds)


@cache
def real() -> Diagnosis:
    """Two effects at joints, and a camera that drifts."""
    made = session((drives.JointGain(at(2, 0.02)), drives.Backlash(at(1, 5e-3), 0.0)), n=150)
    t_s = 60.0 * np.arange(len(made))
    drift = np.outer(t_s / 3600, (1e-3, -2e-3, 1e-3))
    rows = dataclasses.replace(made, xyz=made.xyz + drift, columns={"t_s": t_s})
    return diagnose(ARM, rows, kinds=(*AT_JOINTS, CameraDrift, BaseSettling))


def touched(session: str) -> Diagnosis:
    arm = Arm.load(TOUCHED / "arm.yaml")
    return diagnose(arm, read_csv(TOUCHED / session, arm))


def panda_3() -> Diagnosis:
    return touched("panda_3.csv")


def panda_7() -> Diagnosis:
    """Only a cause without a name is found."""
    return touched("panda_7.csv")


def justin(data: Path) -> Diagnosis:
    right, _ = real_sessions.justin(data)
    return diagnose(right.arm, right.train.take(np.arange(120)))


class Network:
    """Stands for a network that was kept."""


def drawn(seed: int, base: Diagnosis) -> Diagnosis:
    """Another diagnosis: of the same arm, all that a sentence may speak of drawn anew."""
    rng = np.random.default_rng(seed)
    found = base.findings[: int(rng.integers(len(base.findings) + 1))]
    written = "calibrated" if not found or rng.random() < 0.1 else "with_effects"
    network: Any = Network() if rng.random() < 0.3 else None
    size = 10 ** rng.uniform(-4, -1.5)
    n = len(base.proof.errors["nominal"])

    def left() -> np.ndarray:
        tail = 1 + 4 * (rng.random((n, 1)) < 0.05)
        return np.asarray(size * rng.uniform(0.05, 1.5) * tail * rng.standard_normal((n, 3)))

    stages = [*base.models, *(["with_network"] if network else [])]
    seen = {stage: left() for stage in stages}
    alike = rng.random() < 0.5
    commanded = seen if alike else {stage: left() for stage in stages}
    flag = bool(rng.integers(2)) or network is not None
    structure = dataclasses.replace(
        base.structure,
        flag=flag,
        p_value=float(10 ** rng.uniform(-4, 0)),
        inputs=("q2", "t_s") if flag else (),
        size_m=float(size * rng.uniform(0, 1.2)) if flag else 0.0,
        share_explained=float(rng.random()) if flag else 1.0,
        sign="shows in the held-out poses" if flag and rng.random() < 0.3 else "",
    )
    noise = dataclasses.replace(
        base.explained.noise, sigma=np.full(3, size * rng.uniform(0.01, 1.5)), source="residual"
    )
    return dataclasses.replace(
        base,
        explained=dataclasses.replace(base.explained, noise=noise),
        findings=tuple(varied(f, rng, written) for f in found),
        structure=structure,
        proof=dataclasses.replace(
            base.proof,
            errors=seen,
            commanded=commanded,
            turned=dict.fromkeys(seen, np.zeros((0, 3))),
        ),
        causes=(),
        written=written,
        network=network,
        split_by=(),
    )


def varied(finding: Finding, rng: np.random.Generator, written: str) -> Finding:
    """A finding with other odds, and sometimes a name that cannot be told from it."""
    odds, chance = float(rng.uniform(0, 60)), float(rng.uniform(0, 0.5))
    other = "joint_gain" if "bearing_tilt" in finding.names else "bearing_tilt"
    best = RunnerUp(effect=other, log_bayes_factor=odds - float(rng.uniform(0, 20)))
    names = (*finding.names, other) if chance > 0.05 else finding.names
    chances = {name: (1 - chance) * p for name, p in finding.chances} | {other: chance}
    changed: dict[str, Any] = {
        "log_bayes_factor": odds,
        "probability": float(rng.choice([0.96, 0.9995])),
        "names": names,
        "set_probability": {name: chances[name] for name in names},
        "runner_up": best,
    }
    if written == "calibrated":
        bare = tuple(p.model_copy(update={"ci95": None}) for p in finding.parameters)
        changed |= {"parameters": bare, "compensated": False, "left_out": True}
    return finding.model_copy(update=changed)
