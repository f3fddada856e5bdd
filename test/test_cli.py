"""The program ``longarm``: its help, its exit codes, what it loads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from cli_shell import Shell

from longarm_comp.cli import registry, run

HEAVY = ("torch", "numpy", "scipy", "matplotlib", "rclpy", "rich", "pydantic", "sklearn")


def test_help_loads_nothing_heavy() -> None:
    program = (
        "import sys\nfrom longarm_comp.cli.run import run\ncode = run(['--help'])\n"
        f"print([name for name in {HEAVY} if name in sys.modules], code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[] 0"
    for entry in registry.COMMANDS:
        if " " not in entry.name:
            assert f"  {entry.name} " in done.stdout


@pytest.mark.parametrize("entry", registry.COMMANDS, ids=lambda entry: entry.name)
def test_every_command_is_there_and_helps(entry: registry.Entry, shell: Shell) -> None:
    assert shell(*entry.name.split(), "--help") == 0
    assert shell.out.startswith(f"Usage: longarm {entry.name} ")
    assert "Example" in shell.out


def test_small_matrices_get_one_thread_unless_told_otherwise() -> None:
    program = (
        "import os\nfrom longarm_comp.cli.run import run\nrun(['schema'])\n"
        "print(os.environ['OMP_NUM_THREADS'], os.environ['OPENBLAS_NUM_THREADS'])"
    )
    env = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env={**env, "OMP_NUM_THREADS": "2"},
    )
    assert done.stdout.splitlines()[-1] == "2 1"


def test_no_file_of_a_command_is_forgotten() -> None:
    folder = Path(run.__file__).parent
    files = {p.stem for p in folder.glob("*.py") if "\ndef command(" in p.read_text("utf-8")}
    assert files == {entry.module for entry in registry.COMMANDS}


def test_unknown_words_leave_with_2(shell: Shell) -> None:
    assert shell("calibrat") == 2
    assert "calibrat" in shell.err
    assert shell("plan", "--kind", "spiral") == 2
    assert shell("calibrate", "arm.yaml") == 2


def test_a_bug_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    @click.command()
    def broken() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(run, "root", lambda: broken)
    with pytest.raises(ZeroDivisionError):
        run.run([])


def test_interrupt(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    @click.command()
    def stopped() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "root", lambda: stopped)
    assert run.run([]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_module_and_program_are_the_same() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "longarm_comp", "compensate", "none.yaml", "1", "2", "3"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("longarm: none.yaml: file: ")
    assert done.stderr.count("\n") == 1
