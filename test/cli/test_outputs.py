"""What commands may overwrite, and what they read: one rule for all of them."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from cli_shell import Shell

from longarm_comp.cli.outputs import Output
from longarm_comp.cli.registry import COMMANDS
from longarm_comp.cli.run import root

WRITES = ("-o", "--output", "--out", "--save")
REFUSES_ITSELF = {("demo", "--out"), ("soak", "--out"), ("stereo calibrate", "--save")}
"""These take a new or an empty folder only."""


def command_of(name: str) -> click.Command:
    found: click.Command = root()
    for word in name.split():
        assert isinstance(found, click.Group)
        inner = found.get_command(click.Context(found), word)
        assert inner is not None
        found = inner
    return found


@pytest.mark.parametrize("entry", COMMANDS, ids=lambda entry: entry.name)
def test_every_option_that_names_an_output_is_under_the_rule(entry: object) -> None:
    name = str(entry.name)  # type: ignore[attr-defined]
    options = [p for p in command_of(name).params if isinstance(p, click.Option)]
    for option in options:
        for word in set(option.opts) & set(WRITES):
            assert isinstance(option, Output) or (name, word) in REFUSES_ITSELF, word
    outputs = [o for o in options if isinstance(o, Output)]
    assert bool(outputs) == any("--force" in o.opts for o in options)


def kept(shell: Shell, file: str, *words: object) -> str:
    """What is said by a command that is refused, which leaves the file as it was."""
    path = shell.folder / file
    before = path.read_bytes()
    said = shell.refused(*words)
    assert path.read_bytes() == before
    assert "--force" in said
    return said


def test_no_input_is_overwritten(work: Path, shell: Shell) -> None:
    folder = shell.folder
    for name in ("arm.yaml", "samples.csv"):
        shutil.copy(work / name, folder / name)
    (folder / "targets.csv").write_text("x,y,z\n0.4,0.1,0.3\n")
    os.symlink("arm.yaml", folder / "link.yaml")
    os.link(folder / "samples.csv", folder / "hard.csv")
    plan = ("plan", "arm.yaml", "--kind", "sobol", "-n", 3, "-o")
    for output in ("arm.yaml", "link.yaml", f"../{folder.name}/arm.yaml"):
        assert "is the input arm.yaml" in kept(shell, "arm.yaml", *plan, output)
    assert "is the input" in kept(shell, "samples.csv", "import-data", "samples.csv")
    fit = ("calibrate", "arm.yaml", "samples.csv", "-o")
    assert "is the input" in kept(shell, "samples.csv", *fit, "hard.csv")
    aim = ("compensate", "arm.yaml", "--targets", "targets.csv", "-o", "targets.csv")
    assert "is the input" in kept(shell, "targets.csv", *aim)
    shutil.copy(folder / "samples.csv", folder / "second.csv")
    again = ("import-data", "second.csv", "-o", "samples.csv")  # a session, maybe edited by hand
    assert "is not a file that import-data writes" in kept(shell, "samples.csv", *again)
    (folder / "samples.mapping.yaml").write_text("columns: {}")
    mapped = ("import-data", "second.csv", "--like", "samples.mapping.yaml")
    assert "samples.mapping.yaml" in kept(shell, "samples.mapping.yaml", *mapped)


def test_what_exists_is_replaced_by_its_own_kind_only(work: Path, shell: Shell) -> None:
    folder = shell.folder
    for name in ("arm.yaml", "samples.csv"):
        shutil.copy(work / name, folder / name)
    (folder / "notes.txt").write_text("bought in 2019")
    plan = ("plan", "arm.yaml", "--kind", "sobol", "-n", 3)
    assert "is not a file that plan writes" in kept(shell, "notes.txt", *plan, "-o", "notes.txt")
    assert "is not a file that plan writes" in kept(
        shell, "samples.csv", *plan, "-o", "samples.csv"
    )
    marker = ("stereo", "marker", "--board", "7x5", "-o", "photo.pdf")
    (folder / "photo.pdf").write_bytes(b"%PDF a photo")
    kept(shell, "photo.pdf", *marker)
    (folder / "photo.pdf").unlink()
    for _ in range(2):
        assert shell(*marker) == 0
    assert shell(*plan, "-o", "notes.txt", "--force") == 0
    assert (folder / "notes.txt").read_text().startswith("index,")
    urdf = ("export-urdf", "arm.yaml", "--model", "model.yaml")
    fit = ("calibrate", "arm.yaml", "samples.csv")
    for command in (fit, fit, urdf, urdf):
        assert shell(*command) == 0


def test_a_diagnosis_goes_into_its_own_folder(work: Path, shell: Shell) -> None:
    folder = shell.folder
    for name in ("arm.yaml", "samples.csv"):
        shutil.copy(work / name, folder / name)
    assert shell("calibrate", "arm.yaml", "samples.csv") == 0
    asked = ("diagnose", "arm.yaml", "samples.csv")
    kept(shell, "model.yaml", *asked, "-o", ".")
    kept(shell, "model.yaml", *asked, "--model", "model.yaml", "-o", ".")


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(
    work: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("longarm_comp.core.identify.diagnose.diagnose", None)
    (shell.folder / "taken").write_text("a file")
    said = shell.refused(
        "diagnose", str(work / "arm.yaml"), str(work / "samples.csv"), "-o", "taken/out"
    )
    assert "output folder: 'Not a directory'; allowed: a folder to write in" in said


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: os.symlink("/dev/zero", path)])
def test_what_has_no_end_is_not_read(
    make: Callable[[Path], None], work: Path, shell: Shell
) -> None:
    endless = shell.folder / "endless"
    make(endless)
    shutil.copy(work / "arm.yaml", shell.folder / "arm.yaml")
    for words in (
        ("check", "endless"),
        ("calibrate", "endless", "endless"),
        ("calibrate", "arm.yaml", "endless"),
        ("compensate", "arm.yaml", "--targets", "endless"),
        ("compensate", "arm.yaml", "0.7", "0", "0.4", "--predictor", "endless"),
        ("import-data", "endless", "-o", "made.csv"),
        ("init", "made", "--urdf", "endless"),
        ("bag", "info", "endless"),
        ("plan", "arm.yaml", "--kind", "sobol", "-n", 2, "-o", "endless"),
    ):
        assert "a regular file" in shell.refused(*words), words
