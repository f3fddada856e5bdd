"""The study of a working day: what each way of commanding leaves, on a small arm in seconds."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from small_arm import ARM

from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.plays import FrictionHysteresis
from longarm_comp.core.effects.slow_changes import ThermalGrowth
from studies import day, day_work
from studies.day import command

KINDS = (JointGain, GearEccentricity, FrictionHysteresis, ThermalGrowth)
SETTING = day_work.DaySetting(ARM, moves=5, rows=200, warming_k=60.0, kinds=KINDS)


@pytest.fixture(scope="module")
def worn() -> day_work.DayOutcome:
    return day_work.one_day(SETTING, 0)


@pytest.mark.long
def test_each_knowledge_lowers_the_error_of_the_true_tip(worn: day_work.DayOutcome) -> None:
    none, once, told, learned = 1e3 * np.nanmean(worn.error, axis=1)
    assert none > 3.0
    assert once < 0.5 * none
    assert told < once
    assert learned < 0.4 * told


@pytest.mark.long
def test_the_joint_that_wears_is_named_without_a_stop(worn: day_work.DayOutcome) -> None:
    grows = float(worn.t_h[np.argmax(worn.play_rad > worn.play_rad[0])])
    (hour, said), *others = worn.changes
    assert not others
    assert "joint 2" in said
    assert grows <= hour < grows + 15 / SETTING.moves


@pytest.mark.long
def test_without_wear_nothing_is_named_and_nothing_is_lost() -> None:
    told, learns = day_work.WAYS[2:]
    calm = day_work.one_day(day_work.replace(SETTING, growth_rad=0.0, hours=4), 1, (told, learns))
    assert calm.changes == () and calm.stops == ()
    before, learned = 1e3 * calm.error.mean(axis=1)
    assert learned < before + 0.02


def test_an_hour_of_every_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is known beside the model helps; the command's table and files are of the days lived."""
    worn = day_work.one_day(day_work.replace(SETTING, hours=1, rows=100), 0)
    none, once, told, learned = 1e3 * np.nanmean(worn.error, axis=1)
    assert none > 2.0 and once < 0.5 * none and told < once and learned < once
    asked: list[tuple[day_work.DaySetting, int]] = []

    def lived(setting: day_work.DaySetting, seed: int) -> day_work.DayOutcome:
        asked.append((setting, seed))
        return worn

    monkeypatch.setattr(day, "one_day", lived)
    arm = tmp_path / "arm.yaml"
    arm.write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_none=True)))
    out = tmp_path / "day"
    words = ["--arm", str(arm), "--arms", "2", "--hours", "8", "--moves", "5", "--seed", "4"]
    done = CliRunner().invoke(command, [*words, "--json", "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert [(s.arm.name, s.hours, s.moves, seed) for s, seed in asked] == [
        ("small", 8, 5, 4),
        ("small", 8, 5, 5),
    ]
    printed = json.loads(done.stdout)
    assert len(printed["stops"]) == 2 * len(worn.stops)
    assert len(printed["changes"]) == 2 * len(worn.changes)
    assert [row["commanded"] for row in printed["rows"]] == [way.name for way in day_work.WAYS]
    assert json.loads((out / "day.json").read_text()) == printed
    assert (out / "day.png").read_bytes().startswith(b"\x89PNG")
    again = CliRunner().invoke(command, [*words, "--json", "-o", str(out)])
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout) == printed
    assert len(asked) == 2  # both days were on disk
