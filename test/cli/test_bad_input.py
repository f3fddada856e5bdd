"""Bad input on the command line: one line that says what is wrong, and its exit code."""

import csv
import shutil
from pathlib import Path

import click
import numpy as np
import pytest
from cli_shell import ENTRIES, Shell, click_command
from small_arm import ARM

from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn import predictor_file
from longarm_comp.sessions.csv import read_csv, write_csv


def edited(work: Path, old: str, new: str) -> str:
    """samples.csv with something replaced, in the present folder."""
    text = (work / "samples.csv").read_text()
    assert old in text
    Path("bad.csv").write_text(text.replace(old, new))
    return "bad.csv"


def test_misspelt_column(work: Path, shell: Shell) -> None:
    bad = edited(work, "repeat_id", "repeatid")
    line = shell.refused("calibrate", work / "arm.yaml", bad)
    assert line == (
        "longarm: bad.csv: column repeatid: 'unknown, close to repeat_id'; "
        "allowed: repeat_id, or another name"
    )
    assert not Path("model.yaml").exists()


def test_millimetres_for_metres(work: Path, shell: Shell) -> None:
    session = read_csv(work / "samples.csv", ARM)
    write_csv(Session.record(session.q, 1e3 * session.xyz), "mm.csv")
    for command in (
        ("calibrate", work / "arm.yaml", "mm.csv"),
        ("train", work / "arm.yaml", "mm.csv"),
        ("evaluate", work / "arm.yaml", "--test", "mm.csv"),
    ):
        assert "millimetres" in shell.refused(*command)


def test_one_row_is_enough_to_evaluate_but_not_to_calibrate(work: Path, shell: Shell) -> None:
    write_csv(read_csv(work / "test.csv", ARM).take([0]), "one.csv")
    assert shell("evaluate", work / "arm.yaml", "--test", "one.csv") == 0
    assert "rows: 1" in shell.refused("calibrate", work / "arm.yaml", "one.csv")


def test_corrupt_predictor(work: Path, shell: Shell) -> None:
    whole = (work / "predictor.npz").read_bytes()
    Path("cut.npz").write_bytes(whole[: len(whole) // 2])
    evaluate = ("evaluate", work / "arm.yaml", "--test", work / "test.csv")
    line = shell.refused(*evaluate, "--model", work / "model.yaml", "--predictor", "cut.npz")
    assert "cut.npz" in line


def test_predictor_of_another_model(work: Path, shell: Shell) -> None:
    evaluate = ("evaluate", work / "arm.yaml", "--test", work / "test.csv")
    line = shell.refused(*evaluate, "--predictor", work / "predictor.npz")
    assert "model_hash" in line


def test_model_of_another_arm(work: Path, shell: Shell) -> None:
    text = (work / "arm.yaml").read_text()
    Path("other.yaml").write_text(text.replace("d_m: 0.4", "d_m: 0.41"))
    line = shell.refused("evaluate", "other.yaml", "--test", work / "test.csv", "--model",
                         work / "model.yaml")  # fmt: skip
    assert "arm.hash" in line


def test_model_that_is_not_there(work: Path, shell: Shell) -> None:
    with_predictor = ("--model", "none.yaml", "--predictor", work / "predictor.npz")
    for command in (
        ("train", work / "arm.yaml", work / "samples.csv", "--model", "none.yaml"),
        ("evaluate", work / "arm.yaml", "--test", work / "test.csv", *with_predictor),
        ("compensate", work / "arm.yaml", 0.5, 0, 0.2, *with_predictor),
    ):
        assert shell.refused(*command).startswith("longarm: none.yaml: file: ")


def test_unreachable_target(work: Path, shell: Shell) -> None:
    Path("t.csv").write_text("x,y,z\n9,0,0\n0.5,0,0.2\n")
    line = shell.refused("compensate", work / "arm.yaml", "--targets", "t.csv", code=3)
    assert "target 0: unreachable" in line
    with open("commands.csv", newline="") as file:
        statuses = [row["status"] for row in csv.DictReader(file)]
    assert statuses[0] == "unreachable"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("1", "2"), "target"),
        (("1", "2", "nan"), "target"),
        (("1", "2", "--metod"), "--metod"),
        (
            ("--targets", "t.csv", "--metod", "both"),
            "'--metod'; allowed: numbers in m, or a known option",
        ),
        (("1", "2", "3", "--seed-q", "1,2"), "--seed-q"),
        (("1", "2", "3", "--method", "network"), "--predictor"),
        ((), "one of X Y Z, --targets FILE"),
    ],
)
def test_bad_targets(words: tuple[str, ...], said: str, work: Path, shell: Shell) -> None:
    assert said in shell.refused("compensate", work / "arm.yaml", *words)


def test_outputs_that_cannot_be_written(work: Path, shell: Shell) -> None:
    for command in (
        ("calibrate", work / "arm.yaml", work / "samples.csv"),
        ("train", work / "arm.yaml", work / "samples.csv", "--ensemble", 1, "--hidden", 2),
        ("plan", work / "arm.yaml", "--kind", "sobol", "-n", 3),
        ("compensate", work / "arm.yaml", 0.5, 0, 0.2),
    ):
        assert "output folder" in shell.refused(*command, "-o", "/proc/longarm/out")


def test_arm_that_is_none(work: Path, shell: Shell) -> None:
    text = (work / "arm.yaml").read_text()
    Path("typo.yaml").write_text(text.replace("convention", "convntion"))
    line = shell.refused("calibrate", "typo.yaml", work / "samples.csv")
    assert "convntion" in line or "convention" in line


NONSENSE = {
    "a noise that is no number": ("plan", "--kind", "i-optimal", "-n", 5, "--noise-mm", "nan"),
    "an endless noise": ("plan", "--kind", "i-optimal", "-n", 5, "--noise-mm", "inf"),
    "no noise": ("plan", "--kind", "i-optimal", "-n", 5, "--noise-mm", "1e-300"),
    "no floor": ("plan", "--kind", "sobol", "-n", 5, "--floor=-inf"),
    "a share that is none": ("calibrate", "samples.csv", "--fraction", "nan"),
    "a row of 5,000 digits": ("compensate", 0.4, 0.1, 0.3, "--lock", "7" * 5000),
    "a row that the arm lacks": ("compensate", 0.4, 0.1, 0.3, "--lock", 0),
}


@pytest.mark.parametrize("words", NONSENSE.values(), ids=NONSENSE)
def test_numbers_that_are_nonsense_are_refused(
    words: tuple[object, ...], work: Path, shell: Shell
) -> None:
    shutil.copy(work / "samples.csv", shell.folder / "samples.csv")
    first, *rest = words
    assert shell(first, work / "arm.yaml", *rest) == 2
    assert "Traceback" not in shell.err and len(shell.err) < 1000


def test_a_file_of_effects_that_leaves_is_refused(work: Path, shell: Shell) -> None:
    (shell.folder / "effects.py").write_text("import sys\nsys.exit(0)\n")
    assert "SystemExit" in shell.refused("effects", "--effects", "effects.py")


@pytest.mark.parametrize("name", ["gain", "noise", "widen", "alone", "weights"])
@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e308, np.nan])
def test_a_predictor_with_numbers_that_are_nonsense_is_refused(
    name: str, value: float, work: Path, tmp_path: Path
) -> None:
    with np.load(work / "predictor.npz") as data:
        arrays = {key: data[key] for key in data.files}
    arrays[name] = arrays[name].copy()
    arrays[name].flat[0] = value
    np.savez(tmp_path / "predictor.npz", **arrays)
    if name in ("gain", "alone") and value == np.inf:  # not known
        predictor_file.load(tmp_path / "predictor.npz")
        return
    with pytest.raises(InputError, match=name):
        predictor_file.load(tmp_path / "predictor.npz")


@pytest.mark.parametrize("said", ["1left", "left arm", "left//gripper", "left-arm"])
def test_a_namespace_that_the_middleware_does_not_take(said: str, shell: Shell) -> None:
    assert shell("status", "--namespace", said) == 2
    assert repr(said) in shell.err and "Traceback" not in shell.err


def test_a_namespace_may_have_slashes_at_its_ends() -> None:
    for name in ("status", "apply", "collect", "record", "up", "bag to-csv"):
        command = click_command(name)
        option = next(o for o in command.params if o.name == "namespace")
        assert option.callback is not None
        assert option.callback(click.Context(command), option, "/boom/left/") == "boom/left"


def test_what_a_command_must_have_is_asked_for(shell: Shell) -> None:
    needs = {name: [p for p in click_command(name).params if p.required] for name in ENTRIES}
    assert needs["record"] and needs["study loop"]
    for name, required in needs.items():
        for missing in required:
            words: list[str] = []
            for given in (p for p in required if p is not missing):
                value = given.type.choices[0] if isinstance(given.type, click.Choice) else "1"
                words += [given.opts[0], value] if isinstance(given, click.Option) else [value]
            assert shell(*name.split(), *words) == 2, f"{name} without {missing.name}"
            assert "Missing" in shell.err, f"{name} without {missing.name}: {shell.err}"
