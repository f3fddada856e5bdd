"""The program ``longarm``: its help, its exit codes, what it loads."""

import os
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest
from cli_shell import ENTRIES, Shell

from longarm_comp.cli import registry, run

HEAVY = ("numpy", "scipy", "matplotlib", "rclpy", "rich", "pydantic", "sklearn")


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


@pytest.mark.parametrize("name", ENTRIES)
def test_every_command_is_there_and_helps(name: str, shell: Shell) -> None:
    assert shell(*name.split(), "--help") == 0
    assert shell.out.startswith(f"Usage: longarm {name} ")
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
    root = Path(run.__file__).parents[2]
    files = {
        ".".join(path.relative_to(root).with_suffix("").parts)
        for folder in (Path(run.__file__).parent, root / "studies")
        for path in folder.glob("*.py")
        if re.search(r"^(@click.command|@study_command)", path.read_text("utf-8"), re.M)
    }
    listed = {f"{folder}.{e.module.partition(':')[0]}" for e, folder in ENTRIES.values()}
    assert files == listed - {"longarm_comp.cli.bench.command"}  # which is beside the package


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
