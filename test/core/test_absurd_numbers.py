"""Numbers that no arm has end in one line, whatever computes with them."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cli_shell import Shell
from loaded_arm import arm_data
from touching import ARM as TOUCHED
from touching import DISTANCES, errors_of_the_drawing, touching

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.admission import admit
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.predictor_file import load
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import write_csv


def loaded(rng: np.random.Generator, kg: float) -> tuple[Arm, Session]:
    data = arm_data()
    data["payload"]["most_kg"] = 1e6
    arm = Arm.parse(data, "arm.yaml")
    q = arm.lower + rng.random((60, arm.n)) * (arm.upper - arm.lower)
    xyz = Model(arm).tip(q) + 1e-4 * rng.standard_normal((60, 3))
    return arm, Session.record(q, xyz, columns={"payload_kg": np.full(60, kg)}, source="s.csv")


@pytest.mark.parametrize("kg", [1e6])
def test_a_load_that_no_beam_carries(kg: float, rng: np.random.Generator, shell: Shell) -> None:
    arm, session = loaded(rng, kg)
    data = arm.model_dump(mode="json", exclude_defaults=True)
    (shell.folder / "arm.yaml").write_text(yaml.safe_dump(data))
    write_csv(session, shell.folder / "s.csv")
    for words in (
        ("calibrate", "arm.yaml", "s.csv", "-o", "m.yaml"),
        ("diagnose", "arm.yaml", "s.csv", "-o", "d"),
        ("evaluate", "arm.yaml", "--test", "s.csv"),
    ):
        assert f"payload_kg: {kg}; allowed: a load that the beams" in shell.refused(*words)
    one = dataclasses.replace(session, columns={"payload_kg": np.where(np.arange(60) == 7, kg, 0)})
    with pytest.raises(InputError, match="a load that the beams"):
        admit(one, arm)
    admit(dataclasses.replace(session, columns={}), arm)
    heavy = arm.model_copy(update={"payload": arm.payload.model_copy(update={"mass_kg": 1e6})})  # type: ignore[union-attr]
    with pytest.raises(InputError, match="a load that the beams"):
        admit(dataclasses.replace(session, columns={}), heavy)


@pytest.mark.parametrize("value", [1e308, 1e30])
@pytest.mark.parametrize("key", ["scale", "variance_limit"])
def test_a_network_of_absurd_scale(key: str, value: float, work: Path, tmp_path: Path) -> None:
    held = dict(np.load(work / "predictor.npz"))
    header = {**json.loads(held["header"].tobytes()), key: value}
    held["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez(tmp_path / "bad.npz", **held)
    with pytest.raises(InputError, match=rf"bad\.npz: {key}: .*less than or equal to"):
        load(tmp_path / "bad.npz")


@pytest.fixture(scope="module")
def touched() -> Session:
    return touching(errors_of_the_drawing(), 60)


@pytest.mark.parametrize(
    ("length", "tolerance", "words"),
    [
        pytest.param(1e300, 1e-4, "less than or equal to", marks=pytest.mark.long),
        pytest.param(0.05, 1e300, "less than or equal to", marks=pytest.mark.long),
        (0.05, 1e-300, "greater than or equal to"),
        (50.0, 1e-4, "as the arm touched them (this looks like millimetres)"),
        (0.3, 1e-4, "as the arm touched them"),
    ],
)
def test_a_known_distance_that_the_arm_did_not_touch(
    length: float, tolerance: float, words: str, touched: Session, shell: Shell
) -> None:
    known = ((*DISTANCES[0][:2], length, tolerance), *DISTANCES[1:])
    rows = dataclasses.replace(touched, touch_distances=known)
    data = TOUCHED.model_dump(mode="json", exclude_defaults=True)
    (shell.folder / "arm.yaml").write_text(yaml.safe_dump(data))
    write_csv(rows, shell.folder / "s.csv")
    said = shell.refused("calibrate", "arm.yaml", "s.csv", "-o", "m.yaml")
    assert words in said
    assert not (shell.folder / "m.yaml").exists()


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("index", [np.nan, 1], "'nan'; allowed: whole numbers"),
        ("index", np.array([0.0, np.inf]), "'inf'; allowed: whole numbers"),
        ("index", [0.5, 1], "'0.5'; allowed: whole numbers"),
        ("repeat_id", [np.nan, 1], "'nan'; allowed: whole numbers"),
        ("approach", ["up", "down"], "'up'\"; allowed: numbers"),
        ("approach", [1.0], "'shape (1,)'; allowed: shape (2,) or (2, 3)"),
        ("run_up", [["a"] * 3] * 2, "'a'\"; allowed: numbers"),
        ("xyz", [["a"] * 3] * 2, "'a'\"; allowed: numbers"),
        ("q", [[0.0], [0.0, 1.0]], "allowed: numbers"),
    ],
)
def test_rows_that_are_no_numbers(field: str, value: Any, said: str) -> None:
    rows = {"q": np.zeros((2, 3)), "xyz": np.zeros((2, 3)), field: value}
    with pytest.raises(InputError) as refused:
        Session.record(source="s.csv", **rows)
    assert str(refused.value).startswith(f"s.csv: {field}: ") and said in str(refused.value)


@pytest.mark.parametrize("name", ["tip", "pose", "measured"])
def test_the_tip_at_another_number_of_joints_is_refused(name: str) -> None:
    arm = Arm.parse(arm_data(), "arm.yaml")
    predict = getattr(Model(arm), name)
    for q in (0.1, np.zeros(arm.n + 1), np.zeros((3, arm.n - 1))):
        with pytest.raises(InputError, match=f"joint values.*allowed: {arm.n}: ") as found:
            predict(q)
        assert found.value.field == "q"


def test_the_tip_of_a_command_that_failed_is_not_known_and_no_rows_have_no_tip() -> None:
    model = declared_model(Arm.parse(arm_data(), "arm.yaml"))
    assert np.isnan(model.tip(np.full(model.arm.n, np.nan))).all()
    assert model.tip(np.zeros((0, model.arm.n))).shape == (0, 3)
