"""What needs no recorded column goes on without the effects that one drives."""

from pathlib import Path

import numpy as np
import pytest

import longarm_comp as la
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.online import Readings
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.data.commanded import as_commanded
from longarm_comp.core.effects.camera_errors import CameraDrift, CameraScale
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.model.link_frames import outline, reach
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.core.planning.optimal_poses import Measure
from longarm_comp.core.vibration.modes import find_modes
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.workflows.plan import plan

TOLD = Context(columns={"pump_bar": 1.5})


@pytest.fixture(scope="module")
def models(demo_arm_path: Path) -> tuple[Model, Model]:
    """An arm that sways with its pump, and the same without."""
    still = Model(la.Arm.load(demo_arm_path), (LinkDeflection(), JointCompliance(2, 1e-3)))
    sways = Discovered("base", "move x", "linear(pump_bar)", "pump_bar 1..2", 1e-3, 2e-3)
    return still.plus(sways), still


def test_a_model_without_what_nobody_told_is_itself_where_all_is_told(
    models: tuple[Model, Model],
) -> None:
    sways, still = models
    assert sways.told_by(Context()).effects == still.effects
    assert not still.plus(CameraDrift(x=1e-6)).told_by(Context()).biases  # it needs the time
    assert sways.told_by(TOLD) is sways
    loose = still.plus(Backlash(joint=1, width=1e-3))
    assert loose.told_by(Context()) is loose  # an unknown side is in the middle of the play
    with pytest.raises(la.InputError, match="pump_bar"):
        sways.tip(sways.arm.mid)


def test_outline_reach_and_modes(models: tuple[Model, Model]) -> None:
    sways, still = models
    q = sways.arm.mid
    np.testing.assert_array_equal(outline(sways, q), outline(still, q))
    assert outline(sways, q, TOLD)[-1, 0] - outline(still, q)[-1, 0] == pytest.approx(3e-3, rel=0.1)
    assert reach(sways)[1] == reach(still)[1]
    np.testing.assert_array_equal(find_modes(sways, q).hz, find_modes(still, q).hz)


def test_an_unreachable_target_is_told_as_such(models: tuple[Model, Model]) -> None:
    sways, _ = models
    made = compensate(sways, None, np.array([9.0, 0.0, 0.0]), context=TOLD)[0]
    assert made.status is Status.UNREACHABLE
    assert "joint limits" in made.reason


@pytest.mark.parametrize("measure", ["position", "touch"])
def test_poses_are_planned(models: tuple[Model, Model], measure: Measure) -> None:
    place = models[1].tip(models[1].arm.mid)
    asked = {"kind": "i-optimal", "measure": measure, "points": {"a": tuple(place.tolist())}}
    planned, same = (plan(m.arm, 6, model=m, seed=3, **asked) for m in models)
    assert planned.q.shape == (6, 7)
    np.testing.assert_array_equal(planned.q, same.q)


def test_the_graph_serves_the_model_without_what_no_topic_tells(
    models: tuple[Model, Model], demo_arm_path: Path, tmp_path: Path
) -> None:
    """As `longarm diagnose` counts it in the expected error of commands."""
    sways, still = models
    sways = sways.plus(CameraScale(scale=0.01))
    save_model(tmp_path / "model.yaml", store(sways))
    files = ModelFiles(str(demo_arm_path), str(tmp_path / "model.yaml"))
    assert files.loaded.model.effects == still.effects == as_commanded(sways).effects
    assert files.loaded.model.biases == sways.biases
    assert "left out discovered (a circumstance that no command knows)" in files.report().message
    Readings().context(files.loaded.model, 1.0, 5.0)
