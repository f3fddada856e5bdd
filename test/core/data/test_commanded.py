"""Errors as a command would have them: what a model knows and a command does not is left out."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from hidden_arm import session
from small_arm import ARM

from longarm_comp.core.arm.measuring import CameraPlacement
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Twist
from longarm_comp.core.calibration.calibrate import declared_model
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.compensation.target_frame import find_placement
from longarm_comp.core.data.commanded import (
    as_commanded,
    commanded_errors,
    not_commanded,
    own_way,
    with_frame_shift,
)
from longarm_comp.core.data.measurement import compute_posture, compute_tip_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraDrift, CameraScale
from longarm_comp.core.effects.effect import Bias, Effect, parameter
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.placements import BasePose, SensorPlace
from longarm_comp.core.effects.plays import Backlash, FrictionHysteresis
from longarm_comp.core.effects.slow_changes import Creep, ThermalGrowth
from longarm_comp.core.model.model_file import load_model, save_model, store


@dataclass(frozen=True)
class PumpLift(Effect):
    """The base rises with a pressure that nobody tells a command."""

    name: ClassVar[str] = "pump_lift"
    needs: ClassVar[tuple[str, ...]] = ("pump_bar",)

    lift: float = parameter("m", "rise per bar", prior=1e-3)

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        return {0: (0.0, 0.0, self.lift * posture.context.column("pump_bar"), 0.0, 0.0, 0.0)}


@pytest.fixture(scope="module")
def rows() -> Session:
    """Rows with time, temperature and a pressure, each joint with earlier moves."""
    made = session(n=30, directions=False)
    k = np.arange(len(made))
    columns = {"t_s": 120.0 * k, "temperature_c": 20.0 + 0.2 * k, "pump_bar": np.sin(k)}
    return dataclasses.replace(made, columns=columns)


LEFT_OUT = {"measuring side": CameraDrift(x=2e-3, y=1e-3), "never published": PumpLift(lift=2e-3)}
KEPT = {
    "side of arrival": Backlash(joint=2, width=0.01),
    "temperature": ThermalGrowth(expansion=1e-3),
    "time": Creep(amount=0.3),
}


@pytest.mark.parametrize("term", LEFT_OUT.values(), ids=list(LEFT_OUT))
def test_what_no_command_has_is_left_out(term: Effect, rows: Session) -> None:
    bare = declared_model(ARM)
    model = bare.plus(term)
    assert np.abs(compute_tip_errors(model, rows) - compute_tip_errors(bare, rows)).max() > 5e-4
    seen = compute_tip_errors(model, rows)
    left = commanded_errors(model, rows, seen=seen) - compute_tip_errors(bare, rows)
    frame = left[0] if isinstance(term, Bias) else np.zeros(3)
    assert left == pytest.approx(np.tile(frame, (len(rows), 1)), abs=1e-12)
    assert [term.name in said for said in not_commanded(model, rows)] == [True]


@pytest.mark.parametrize("term", KEPT.values(), ids=list(KEPT))
def test_what_a_command_chooses_or_is_told_stays(term: Effect, rows: Session) -> None:
    model = declared_model(ARM).plus(term)
    seen = compute_tip_errors(model, rows)
    assert np.array_equal(commanded_errors(model, rows), seen)
    assert commanded_errors(model, rows, seen=seen) is seen  # and takes no time
    assert not_commanded(model, rows) == []


def test_of_a_side_that_was_told_nobody_knows_the_moves_before(rows: Session) -> None:
    assert np.count_nonzero(rows.legs[..., 1:]) > 20
    assert np.array_equal(own_way(rows).legs, rows.legs), "moves that were followed are known"
    rows = dataclasses.replace(rows, told=rows.approach)
    known = own_way(rows)
    assert np.array_equal(known.legs[..., 0], rows.legs[..., 0])
    assert np.array_equal(known.approach, rows.approach) and not known.legs[..., 1:].any()
    far = 2.0 * float(np.abs(rows.legs[..., 0]).max())
    model = declared_model(ARM).plus(
        FrictionHysteresis(joint=2, width=0.02, outer=0.02, near=0.01, far=far)
    )
    seen = compute_tip_errors(model, rows)
    assert np.abs(commanded_errors(model, rows, seen=seen) - seen).max() > 1e-4
    assert not_commanded(model, rows) == ["earlier moves of the joints (friction_hysteresis)"]
    assert np.array_equal(commanded_errors(model, known), compute_tip_errors(model, known))


def test_what_moves_all_seen_points_alike_misses_no_target(rows: Session) -> None:
    """Of a drift that the rows hold, the command is charged with its spread, not with its mean."""
    model = with_frame_shift(declared_model(ARM).plus(CameraDrift(x=2e-3, y=1e-3)), rows)
    drift = compute_tip_errors(declared_model(ARM), rows) - compute_tip_errors(model, rows)
    charged = commanded_errors(model, rows) - compute_tip_errors(model, rows)
    assert charged == pytest.approx(drift - drift.mean(axis=0), abs=1e-12)


def test_a_shift_of_the_frame_is_the_same_from_the_posture_of_a_similar_model(
    rows: Session,
) -> None:
    """The posture may hold moves that no command knows; the shift leaves these out."""
    rows = dataclasses.replace(rows, told=rows.approach)
    far = 2.0 * float(np.abs(rows.legs[..., 0]).max())
    played = FrictionHysteresis(joint=2, width=0.02, outer=0.02, near=0.01, far=far)
    arm = ARM.model_copy(update={"camera": CameraPlacement(position_m=(2.0, 0.0, 0.0))})
    model = declared_model(arm).plus(played, CameraScale(scale=0.02))
    near = compute_posture(model.plus(JointZero(2, 1e-3)), rows)
    anew, quick = (with_frame_shift(model, rows, at).frame_shift for at in (None, near))
    assert np.linalg.norm(anew) > 5e-3
    assert quick == pytest.approx(anew, abs=1e-12)


def test_a_target_in_the_frame_of_the_measurements_is_missed_as_the_report_says(
    rows: Session, tmp_path: Path
) -> None:
    """A camera 30 mm off was reported to miss by the spread of its error, and missed by 30 mm."""
    drifting = declared_model(ARM).plus(BasePose(x=1.0), CameraDrift(x=3e-2, y=1e-2))
    seen = dataclasses.replace(rows, xyz=drifting.measured(rows.q, rows.context()))
    fitted = fit_model(declared_model(ARM).plus(BasePose(x=1.0), CameraDrift()), seen)
    save_model(tmp_path / "model.yaml", store(fitted.model))
    model = load_model(tmp_path / "model.yaml", ARM)
    assert model.frame_shift == fitted.model.frame_shift
    assert np.linalg.norm(model.frame_shift) > 5e-3
    there = find_placement(model, "measured")
    tips = as_commanded(model).tip(seen.q, seen.context())
    missed = np.array([there.carry_to_model(xyz) for xyz in seen.xyz]) - tips
    np.testing.assert_allclose(missed, commanded_errors(fitted.model, seen), atol=1e-9)
    np.testing.assert_allclose(missed.mean(axis=0), 0.0, atol=1e-4)
    bare = find_placement(model.with_terms(model.effects), "base")
    np.testing.assert_allclose(bare.motion, find_placement(model, "base").motion)


def test_the_frame_of_a_sensor_stays() -> None:
    placed = SensorPlace(sensor="tracker", x=0.1)
    assert as_commanded(declared_model(ARM).plus(placed)).biases == (placed,)
