"""Inclinometers: declared in arm.yaml, searched where their row is not, misnamed ones refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from few_effects import few_effects, names_alone
from sensed_arm import SIGMA, declared
from small_arm import ARM

import longarm_comp as la
from longarm_comp.core.arm.context import Context
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.effects.measured_tilt import MeasuredTilt
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import read_csv, write_csv
from longarm_comp.sim.arm_truth import TrueArm


def tilted(n: int = 120, columns: tuple[str, str] = ("incl_foot_x", "incl_foot_y")) -> Session:
    """The base leans by up to 10 mrad; the sensor is turned by a quarter and one axis negated."""
    rng = np.random.default_rng(5)
    q = ARM.lower + rng.random((n, ARM.n)) * (ARM.upper - ARM.lower)
    x, y = rng.normal(0, 5e-3, (2, n))
    true = Model(ARM, (MeasuredTilt(frame=0),))
    xyz = true.tip(q, Context(columns={"incl_0_x": x, "incl_0_y": y}))
    xyz += TrueArm(ARM).tip(q) - Model(ARM).tip(q) + SIGMA * rng.standard_normal((n, 3))
    readings = dict(zip(columns, (-y, x), strict=True))
    return Session.record(q, xyz, columns=readings)


def arm(**more: Any) -> la.Arm:
    sensor = {"kind": "inclinometer", "axes": ["y", "x"], "sign": [-1, 1], **more}
    return declared(sensors={"foot": sensor})


def test_a_declared_inclinometer_is_taken_at_its_word() -> None:
    calibrated = la.calibrate(arm(row=0), tilted(), effects=["measured_tilt"])
    errors = calibrated.held_out
    assert errors["geometry"].mean > 5 * errors["measured_tilt"].mean
    assert errors["measured_tilt"].mean < 3 * SIGMA
    with pytest.raises(JobError, match="worse on held-out rows"):
        la.calibrate(arm(row=0, sign=[1, 1]), tilted(), effects=["measured_tilt"])


def test_a_free_gain_is_fitted_and_shown() -> None:
    half = tilted()
    columns = {name: 0.5 * values for name, values in half.columns.items()}
    session = Session.record(half.q, half.xyz, columns=columns)
    found = la.calibrate(arm(row=0, gain="free"), session, effects=["measured_tilt"])
    gain = next(p for p in found.parameters if p.name == "gain")
    assert gain.where == "sensor foot"
    assert gain.value == pytest.approx(2.0, abs=0.05)


def test_the_row_is_searched_where_it_is_not_declared() -> None:
    with few_effects((MeasuredTilt, JointGain)), names_alone():
        found = la.diagnose(arm(), tilted(), network=False)
    assert [(f.name, f.where, f.terms[0].forms["pivot"]) for f in found.findings] == [
        ("measured_tilt", ("sensor foot",), 0)
    ]
    with pytest.raises(InputError, match=r"row in arm.yaml"):
        la.calibrate(arm(), tilted(), effects=["measured_tilt"])


def test_rows_without_a_reading_and_idle_frames_are_left_out(tmp_path: Path) -> None:
    session = tilted(columns=("incl_0_y", "incl_0_x"))
    columns = dict(session.columns)
    columns["incl_0_y"] = -columns["incl_0_y"]
    columns["incl_0_x"] = np.where(np.arange(120) < 9, np.nan, columns["incl_0_x"])
    columns |= {"incl_3_x": np.zeros(120), "incl_3_y": np.zeros(120)}
    whole = Session.record(session.q, session.xyz, columns=columns)
    write_csv(whole, tmp_path / "samples.csv")
    assert read_csv(tmp_path / "samples.csv", ARM).hash == whole.hash
    said: list[str] = []
    found = la.calibrate(ARM, tmp_path / "samples.csv", effects=["measured_tilt"], note=said.append)
    assert found.held_out["measured_tilt"].mean < 3 * SIGMA
    assert len(found.session) == 111
    assert any("9 rows left out" in text for text in said)
    assert any("frame 3 left out" in text for text in said)


def test_a_wrong_frame_is_refused_with_the_known_ones() -> None:
    session = tilted(columns=("incl_bas_x", "incl_bas_y"))
    with pytest.raises(InputError, match=r"incl_bas_x.*0, 1, 2, 3, 4, foot"):
        la.calibrate(arm(row=0), session)
    with pytest.raises(InputError, match=r"sensors.foot.row.*0..4"):
        arm(row=7)
