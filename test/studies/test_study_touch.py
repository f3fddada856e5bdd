"""The study of touches: planted arms through the whole of it, the six real ones as far as rigid."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from touching import ARM, EXAMPLE, SOCKETS, errors_of_the_drawing, touching

import longarm_comp as la
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.data.measurement import compute_touch_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from studies.touch import Left, Touched, command, gains_mm, read

RIGID_MM = {"1": 0.79, "2": 0.285, "3": 0.2, "4": 0.24, "6": 0.24, "7": 0.48}
"""By a script of another hand, rounded up; the drawing alone leaves 2.6 to 8.4 mm."""


def written(path: Path, session: Session) -> Path:
    with path.open("w", newline="", encoding="utf-8") as handle:
        out = csv.writer(handle)
        out.writerow(["location", "socket", *(f"q{j}" for j in range(1, ARM.n + 1))])
        for q, touch in zip(session.q, session.labels["touch"], strict=True):
            out.writerow([*touch.split("_"), *q])
    return path


@pytest.mark.long
@pytest.mark.usefixtures("few_names")
def test_a_planted_arm_goes_through_the_whole_study(tmp_path: Path) -> None:
    sockets = {name: place for name, place in SOCKETS.items() if not name.startswith("high")}
    session = touching(errors_of_the_drawing(), 72, sockets=sockets)
    again = read(written(tmp_path / "one.csv", session), ARM)
    assert again.touch_distances == tuple(
        (f"{p}_0", f"{p}_1", 0.05, 1e-4) for p in ("front", "left")
    )
    done = CliRunner().invoke(command, ["--data", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["arms"][0]
    assert (found["arm"], found["rows"], found["places"]) == ("one", 72, 2)
    assert found["nominal_mm"] > 3.0 > 0.6 > found["rigid_mm"]
    assert found["diagnosed_mm"] < 1.5 * found["rigid_mm"]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] * (n != "1")) for n in RIGID_MM]
)
def test_real_arms_are_calibrated_by_touch(name: str) -> None:
    arm = la.Arm.load(EXAMPLE / "arm.yaml")
    session = la.read_session(EXAMPLE / f"panda_{name}.csv", arm)
    left: dict[str, list[np.ndarray]] = {"frames_only": [], "geometry": []}
    for place in np.unique(session.labels["location"]):
        held = session.labels["location"] == place
        fits = dict(fit_stages(declared_model(arm), session.take(~held)))
        for rung, found in left.items():
            found.append(compute_touch_errors(fits[rung].model, session.take(held)))
    nominal, rigid = (1e3 * np.concatenate(found).mean() for found in left.values())
    assert rigid < RIGID_MM[name]
    assert nominal > 2.0


def test_gains_are_paired_over_places() -> None:
    def place(name: str, size: float) -> Left:
        spread = {"rigid": np.full(4, size), "diagnosed": np.full(4, size - 1e-3)}
        return Left(name, spread, ("play joint 2",))

    arm = Touched("one", 12, tuple(place(str(k), 0.01 * k + 0.01) for k in range(3)))
    assert gains_mm([arm], "diagnosed", "rigid") == pytest.approx((1.0, 1.0, 1.0))
    assert arm.names == ["play joint 2"]


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text("location,q1\nleft,0\n", encoding="utf-8")
    with pytest.raises(InputError, match="column socket: 'missing'"):
        read(tmp_path / "one.csv", ARM)
    done = CliRunner().invoke(command, ["--data", str(EXAMPLE.parent)])
    assert isinstance(done.exception, InputError)
