"""Acceptance on the twin: calibrate and learn on its samples, judge on noise-free test poses."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import declared_model, fit_ladder, geometry_terms
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraRadial
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.drive_errors import JointGain, PrismaticPitch, ServoQuantisation
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis, TelescopeClearance
from longarm_comp.core.identify.run_ups import with_run_ups
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import read_csv

GATE = 0.075  # of the arm's typical torque: 0.36 N m, where the twin's backlash changes side


@dataclass(frozen=True)
class Twin:
    """A case: what was measured, and what is true of its test rows."""

    arm: Arm
    samples: Session
    test: Session
    true: np.ndarray  # (N, 3) m, noise-free
    rigid: np.ndarray  # (N, 3) m, where the rigid declared arm puts the tip

    @classmethod
    def load(cls, folder: Path, case: str) -> Twin:
        arm = Arm.load(str(folder / "twin" / "arm.yaml"))
        at = folder / "twin" / case
        with (at / "answer" / "noise_free.csv").open(newline="", encoding="utf-8") as handle:
            rows = [row for row in csv.DictReader(handle) if row["set"] == "test"]
        test = read_csv(at / "test.csv", arm)
        assert [int(row["index"]) for row in rows] == test.index.tolist()

        def points(prefix: str) -> np.ndarray:
            return np.array([[float(row[prefix + axis]) for axis in "xyz"] for row in rows])

        return cls(arm, read_csv(at / "samples.csv", arm), test, points(""), points("rigid_"))

    def with_run_ups(self, length: float) -> Twin:
        """The same, run-ups of which only the side was recorded taken to be so long (rad)."""
        samples, test = (with_run_ups(s, self.arm, length) for s in (self.samples, self.test))
        return replace(self, samples=samples, test=test)

    def share(
        self, model: Model, expected: np.ndarray | float = 0.0, rows: np.ndarray | None = None
    ) -> float:
        """Mean |z| that is left of the uncompensated one, noise-free, in all rows or some."""
        rows = np.ones(len(self.test), bool) if rows is None else rows
        predicted = model.measured(self.test.q, self.test.context()) + expected
        before = np.abs(self.true - self.rigid)[rows, 2].mean()
        return float(np.abs(self.true - predicted)[rows, 2].mean() / before)

    def calibrated(self) -> Model:
        """Geometry only, on top of the declared sag."""
        return fit_model(
            declared_model(self.arm).plus(*geometry_terms(self.arm, self.samples)), self.samples
        ).model

    def with_network(self, model: Model, ensemble: int) -> float:
        """The share left with so many default networks on what the model leaves.

        The first row is left out: from which side its joints came is not known.
        """
        seen = self.samples.take(self.samples.seen)
        predictor = train(
            seen.q, compute_tip_errors(model, seen), seen.context(), ensemble=ensemble
        )
        found = predictor.predict(self.test.q, self.test.context())
        known = self.test.approach.all(axis=1)
        assert known.sum() >= len(known) - 1
        assert found.in_domain[known].all()
        return self.share(model, found.error, known)


@pytest.mark.parametrize(
    ("samples", "ensemble", "allowed"),
    [(300, 1, 0.22), pytest.param(900, 5, 0.17, marks=pytest.mark.long)],
)
def test_calibrated_and_network(
    data_dir: Path, samples: int, ensemble: int, allowed: float
) -> None:
    """The paper leaves 0.56 and 0.30; a Gaussian process told the approach 0.20 and 0.14.

    With 900 samples the network's start alone makes it 0.14 to 0.16.
    """
    twin = Twin.load(data_dir, f"paper_twin_{samples}")
    model = twin.calibrated()
    assert twin.share(declared_model(twin.arm)) > 0.75
    assert twin.share(model) > 2 * allowed
    assert twin.with_network(model, ensemble) <= allowed


@pytest.mark.parametrize("samples", [300, 900])
def test_the_right_effects_leave_a_twentieth(data_dir: Path, samples: int) -> None:
    """Calibrated with the effects that are in the twin, started from nothing."""
    twin = Twin.load(data_dir, f"paper_twin_{samples}").with_run_ups(0.0524)
    base = declared_model(twin.arm).plus(*geometry_terms(twin.arm, twin.samples))
    rows = [1, 2, 4, 5, 6]
    first = base.plus(
        *JointGain.for_arm(twin.arm),
        *PrismaticPitch.for_arm(twin.arm),
        *FrictionHysteresis.for_arm(twin.arm),
        *(Backlash(joint=row, gate=GATE) for row in rows),
        CameraRadial(),
        *TelescopeClearance.for_arm(twin.arm),
    )
    smooth = fit_model(first, twin.samples).model
    steps = ServoQuantisation.for_arm(twin.arm)
    coarse = [s for s in steps if s.steps_per_turn == 1000]
    full = fit_model(smooth.plus(*coarse), twin.samples).model
    assert twin.share(smooth) < 0.15
    assert twin.share(full) <= 0.05


def test_one_joint_compliance(data_dir: Path) -> None:
    """The ladder ends at the noise where the missing effect is declared, and not before."""
    twin = Twin.load(data_dir, "one_joint_compliance_300")
    rungs = fit_ladder(
        twin.arm, twin.samples, twin.test, [("joint_compliance", JointCompliance.for_arm(twin.arm))]
    )
    left = {
        rung.name: 1e3
        * np.linalg.norm(
            twin.true - rung.model.measured(twin.test.q, twin.test.context()), axis=1
        ).mean()
        for rung in rungs
    }
    assert left["joint_compliance"] < 0.1
    assert left["geometry"] > 2 * left["joint_compliance"]
    assert left["nominal"] > left["geometry"]
