"""A session's clock and order end with it: nothing that commands depends on a clock of another."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hidden_arm import at, session, white
from small_arm import ARM, measured

import longarm_comp as la
from longarm_comp.core.arm.context import ORDER, Context
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.uncertainty import FRAME, with_uncertainty
from longarm_comp.core.compensation.online import Readings, StaleContext
from longarm_comp.core.compensation.result import Status
from longarm_comp.core.effects.camera_errors import CameraDrift
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.slow_changes import BaseSettling
from longarm_comp.core.identify import diagnose as core
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, save_model, store
from longarm_comp.sessions.targets import read_targets
from longarm_comp.workflows.diagnose import DiagnosisResult

ENDED_S = 5400.0
SETTLES = BaseSettling(sink=-4e-3, about_x=0.0, about_y=2e-3)
JUMPED = Discovered(
    "base", "turn z", "switch(t_s, 2700.0, 1.0)", "t_s 0.0..5400.0", 1e-2, 0.01
)  # fmt: skip
SLIPPED = Discovered(
    "base", "move x", f"switch({ORDER}, 30.5, 0.1)", f"{ORDER} 0.0..79.0", 1e-3, 2e-3
)  # fmt: skip
TARGET = Model(ARM).tip(ARM.mid)


def model(*terms: Effect | Bias) -> Model:
    return dataclasses.replace(Model(ARM).plus(*terms), ended_s=ENDED_S)


def lands(made: Model, command: np.ndarray, t_s: float = ENDED_S, pose: float = 79.0) -> np.ndarray:
    """Where the arm's tip comes to rest at the end of the session."""
    tip: np.ndarray = made.tip(command, Context(columns={"t_s": t_s, ORDER: pose}))
    return tip


@pytest.mark.parametrize("term", [SETTLES, JUMPED, SLIPPED], ids=["drift", "switch", "order"])
def test_files_python_and_the_graph_command_the_arm_as_the_session_left_it(
    term: Effect, tmp_path: Path
) -> None:
    made = model(term)
    kept = tmp_path / "model.yaml"
    save_model(kept, store(made))
    made = load_model(kept, ARM)
    (x, y, z) = TARGET.tolist()
    rows = [f"{x},{y},{z},{t_s},{pose}" for t_s, pose in ((0, 0), (45, 3), (9e4, 1e6))]
    (tmp_path / "targets.csv").write_text("\n".join([f"x,y,z,t_s,{ORDER}", *rows]))
    commands = [*la.compensate(made, read_targets(tmp_path / "targets.csv"), seed=ARM.mid)]
    told = [None, *(Context(columns={"t_s": t, ORDER: t}) for t in (1.0, 172.0))]
    commands += [la.compensate(made, TARGET, context=c, seed=ARM.mid)[0] for c in told]
    graph = [Readings().context(made, uptime_s, 60.0) for uptime_s in (45.0, 172.0, 1e6)]
    assert graph[0] == graph[1] == graph[2]
    for found in commands:
        assert found.status is Status.SUCCESS, found.reason
        np.testing.assert_array_equal(found.command, commands[0].command)
        np.testing.assert_allclose(lands(made, found.command), TARGET, atol=2e-6)
    np.testing.assert_allclose(made.tip(commands[0].command, graph[0]), TARGET, atol=2e-6)
    at_the_start = lands(made, commands[0].command, t_s=0.0, pose=0.0)
    assert np.linalg.norm(at_the_start - TARGET) > 1e-3, "it matters when"


def test_times_of_a_path_are_no_session_clock(tmp_path: Path) -> None:
    made, (x, y, z) = model(SETTLES), TARGET.tolist()
    rows = [f"{x},{y},{z + 1e-3 * k},{30 * k}" for k in range(4)]
    (tmp_path / "path.csv").write_text("\n".join(["x,y,z,t_s", *rows]))
    way = la.compensate_path(made, read_targets(tmp_path / "path.csv"), seed=ARM.mid)
    np.testing.assert_allclose(way.timed.times, [0.0, 30.0, 60.0, 90.0])
    for k, found in enumerate(way):
        np.testing.assert_allclose(
            lands(made, found.command), TARGET + np.array([0.0, 0.0, 1e-3 * k]), atol=2e-6
        )


def test_a_fitted_model_knows_when_its_session_ended(rng: np.random.Generator) -> None:
    t_s = np.linspace(1.7e9, 1.7e9 + ENDED_S, 60)
    rows = dataclasses.replace(measured(60, rng, columns={"t_s": t_s}), begun_s=1.7e9)
    assert with_uncertainty(fit_model(Model(ARM), rows)).ended_s == ENDED_S
    assert with_uncertainty(fit_model(Model(ARM), measured(60, rng))).ended_s is None


def test_where_nobody_knows_when_it_ended_no_command_is_guessed(tmp_path: Path) -> None:
    unknown = Model(ARM, (SETTLES,))
    found = la.compensate(unknown, TARGET, context=Context(columns={"t_s": 30.0}))[0]
    assert found.status is Status.STALE_CONTEXT
    assert "does not say when its session ended: calibrate again" in found.reason
    with pytest.raises(StaleContext, match="when its session ended"):
        Readings().context(unknown, 30.0, 60.0)
    older = store(Model(ARM, (JUMPED,), (CameraDrift(x=1e-3),)))  # its function says it
    assert older.ended_s is None
    save_model(tmp_path / "model.yaml", older)
    assert load_model(tmp_path / "model.yaml", ARM).ended_s == ENDED_S


def test_a_base_that_turned_once_is_commanded_as_it_stands_since(tmp_path: Path) -> None:
    """Found by a diagnosis of rows with times, and stored; whatever clock asks for it then."""
    rows = session(n=120)
    t_s = np.linspace(0.0, 278.0, len(rows))
    turned = np.outer(t_s >= 139.0, at(1, np.radians(1.0)))  # joint 1 turns about the base's axis
    xyz = Model(ARM).tip(rows.q + turned) + white(np.random.default_rng(3), len(rows))
    rows = dataclasses.replace(rows, xyz=xyz, columns={"t_s": t_s})
    found = DiagnosisResult(core.diagnose(ARM, rows, kinds=(BaseSettling,)), rows.hash, {})
    inputs = {name for cause in found.diagnosis.causes for name in cause.inputs}
    assert inputs == {"t_s"}, "and no number of a pose, where rows have times"
    assert found.model.ended_s == 278.0, "rows that were held out are of the session too"
    later = dataclasses.replace(rows, columns={"t_s": t_s + 86400.0}, source="later").take(
        t_s > 139
    )
    proven = dataclasses.replace(found.diagnosis, held_out=later)
    assert DiagnosisResult(proven, "", {}).model.ended_s == found.diagnosis.train.ended_s
    kept = tmp_path / "model.yaml"
    save_model(kept, store(found.model))
    made = load_model(kept, ARM)
    command = la.compensate(made, TARGET, seed=ARM.mid)[0].command
    now = np.linalg.norm(Model(ARM).tip(command + at(1, np.radians(1.0))) - TARGET)
    assert now < 3e-4 < 2e-3 < np.linalg.norm(Model(ARM).tip(command) - TARGET)
    for uptime_s in (45.0, 172.0):
        context = Readings().context(made, uptime_s, 60.0)
        np.testing.assert_allclose(made.tip(command, context), TARGET, atol=1e-6)


@pytest.mark.parametrize("slowing", [pytest.param(0.0, marks=pytest.mark.long), 8.0])
def test_targets_are_in_the_frame_that_a_drifting_camera_had_at_first(slowing: float) -> None:
    """For the tip does not move with it; and a camera that warms up is named, as it slows down."""
    rows = session(n=120)
    t_s = np.linspace(500.0, 4100.0, len(rows))
    rows = dataclasses.replace(rows, columns={"t_s": t_s})
    hours = (t_s - t_s[0]) / 3600.0
    done = hours if not slowing else np.expm1(-slowing * hours) / np.expm1(-slowing)
    rate = np.array([4e-3, -3e-3, 2e-3])
    noise = white(np.random.default_rng(5), len(rows))
    rows = dataclasses.replace(rows, xyz=Model(ARM).tip(rows.q) + np.outer(done, rate) + noise)
    found = DiagnosisResult(core.diagnose(ARM, rows, kinds=(CameraDrift,)), rows.hash, {})
    (drift,) = found.findings
    assert drift.names == ("camera_drift",)
    assert drift.terms[0].slowing == pytest.approx(slowing, rel=0.25, abs=0.2)  # type: ignore
    command = la.compensate(found.model, TARGET, seed=ARM.mid, frame="measured")[0].command
    assert np.linalg.norm(Model(ARM).tip(command) - TARGET) < 4e-4
    assert np.linalg.norm(found.diagnosis.fits["with_effects"].model.frame_shift) > 5e-4
    uncertainty = found.model.uncertainty
    assert uncertainty is not None
    assert uncertainty.frame[0, 0] == pytest.approx(np.mean((FRAME * done * rate[0]) ** 2), rel=0.2)
