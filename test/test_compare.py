"""Two diagnoses, models or sessions side by side: what is said follows from what was changed."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cli_shell import Shell
from hidden_arm import session
from report_pages import sample
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.backlash import Backlash
from longarm_comp.core.effects.camera_scale import CameraScale
from longarm_comp.core.effects.joint_zero import JointZero
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import store
from longarm_comp.report.record import checked, text
from longarm_comp.sessions.csv import write_csv
from longarm_comp.workflows.compare import of_diagnoses, of_models, of_sessions


def grown(report: dict[str, Any], times: float) -> dict[str, Any]:
    """The report with a first value so many times as large, its interval too."""
    made = copy.deepcopy(report)
    value = made["findings"][0]["parameters"][0]
    value["value"] *= times
    value["ci95"] = [times * v for v in value["ci95"]]
    return made


def test_a_value_moved_where_the_intervals_do_not_meet() -> None:
    report = sample("named")[0]
    same, little, much = (
        of_diagnoses(checked(report), checked(grown(report, times))) for times in (1.0, 1.05, 2.0)
    )
    assert same.said == ("Verdict named and named, of the same data.", "Both found backlash.")
    assert little.said == same.said
    assert much.said[2:] == (
        "backlash joint 2 gap grew from 0.407° [0.378, 0.441] to 0.814° [0.756, 0.882].",
    )
    assert of_diagnoses(checked(grown(report, 2.0)), checked(report)).said[2].split()[4] == "fell"


def test_what_only_one_found_and_both_errors_are_told() -> None:
    named, noise = (checked(sample(verdict)[0]) for verdict in ("named", "noise"))
    found = of_diagnoses(noise, named)
    assert "Only B found backlash." in found.said
    rows = {row[0]: row[1:] for row in found.tables[1].rows}
    wanted = next(row for row in named.held_out.rows if row.model == "with_effects")
    assert rows["with_effects"] == (None, wanted.commanded_mean_mm, None, wanted.mean_mm)


def test_models_differ_in_effects_values_and_geometry() -> None:
    zero = JointZero(joint=1, offset=0.01)
    held = Model(ARM, (zero, Backlash(joint=2, width=0.01)))
    near = {(1, "width"): (0.009, 0.011)}
    other = Model(
        ARM, (dataclasses.replace(zero, offset=0.02), Backlash(joint=2, width=0.02)),
        (CameraScale(scale=0.01),),
    )  # fmt: skip
    found = of_models(
        store(held, intervals=near), store(other, intervals={(1, "width"): (0.019, 0.021)})
    )
    assert "Only B had camera_scale." in found.said
    assert any(said.startswith("backlash joint 2 width grew from 0.573°") for said in found.said)
    assert found.tables[1].rows == (("joint 1", "offset", "0.573 °", "1.146 °", "+0.573 °"),)


def test_models_of_two_arms_of_one_name_are_refused() -> None:
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    warmer = Arm.parse({**data, "reference_temperature_c": 25.0}, "warmer")
    assert warmer.name == ARM.name and warmer.hash != ARM.hash
    with pytest.raises(InputError, match="as the first model"):
        of_models(store(Model(ARM)), store(Model(warmer)))


def test_sessions_are_compared_where_they_share_poses(rng: np.random.Generator) -> None:
    one = session(n=40)
    order = rng.permutation(40)
    moved = dataclasses.replace(one, xyz=one.xyz + np.array([1e-3, 0.0, -2e-3])).take(order)
    said = of_sessions(one, moved).said
    assert said[0] == "40 common poses."
    assert "by 2.24 mm in the mean" in said[1] and "(+1.00, +0.00, -2.00) mm" in said[1]
    turned = dataclasses.replace(moved, approach=-moved.approach)
    assert of_sessions(one, turned).said == ("0 common poses.",)


def test_the_commands_compare_files(shell: Shell, tmp_path: Path) -> None:
    for name, verdict in (("a", "named"), ("b", "noise")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.json").write_text(text(checked(sample(verdict)[0])))
    (tmp_path / "arm.yaml").write_text(
        yaml.safe_dump(ARM.model_dump(mode="json", exclude_defaults=True))
    )
    write_csv(session(n=10), tmp_path / "one.csv")
    assert shell.json("compare", "a", "b")["kind"] == "diagnoses"
    assert shell("compare", "one.csv", "one.csv", "--arm", "arm.yaml") == 0
    assert "10 common poses." in shell.out
    for wrong, said in (
        (("one.csv", "one.csv"), "--arm"),
        (("a", "one.csv", "--arm", "arm.yaml"), "one of diagnoses"),
        (("a", "none"), "missing"),
    ):
        assert said in shell.refused("compare", *wrong)
