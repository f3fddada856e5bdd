"""Ctrl-C ends a command with one line and exit code 130, also while it still loads."""

import errno
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from cli_shell import Shell

AT_IMPORT = """
import sys
import longarm_comp.cli as cli

class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            raise KeyboardInterrupt

sys.meta_path.insert(0, CtrlC())
cli.main(["export-urdf", "--help"])
"""


@pytest.mark.parametrize(
    "module", ["longarm_comp.cli.run", "longarm_comp.core.errors", "longarm_comp.cli.files"]
)
def test_while_it_loads(module: str) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", AT_IMPORT, module], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr.lstrip()) == (130, "longarm: interrupted\n")


def test_while_it_works(tmp_path: Path) -> None:
    """A file of effects that takes for ever stands for long work."""
    begun, effects = tmp_path / "begun", tmp_path / "slow.py"
    effects.write_text(
        "import pathlib, time\n"
        f"pathlib.Path({str(begun)!r}).touch()\n"
        "while True: time.sleep(0.05)\n"
    )
    command = subprocess.Popen(
        [sys.executable, "-m", "longarm_comp", "effects", "--effects", str(effects)],
        stderr=subprocess.PIPE,
        text=True,
        # As from a terminal: a shell's background jobs, and their children, ignore Ctrl-C
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while not begun.exists() and command.poll() is None:
        time.sleep(0.02)
    command.send_signal(signal.SIGINT)
    _, said = command.communicate(timeout=300)
    assert command.returncode == 130
    assert said.lstrip() == "longarm: interrupted\n"


@pytest.mark.parametrize(
    ("words", "place", "kept"),
    [
        (("loop", "ARM", "-o", "loop_1"), "jobs.loop.Loop.run", "continue with --resume"),
        (("record", "-o", "bag"), "jobs.recorder.record", "--resume adds to it"),
        (("verify", "ARM"), "jobs.targets.TargetRunner.ready", "the same command"),
    ],
    ids=lambda given: given if isinstance(given, str) else "",
)
def test_what_is_kept_and_what_comes_next_are_said(
    words: tuple[str, ...], place: str, kept: str, demo_arm_path: Path, shell: Shell,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A full disk in the midst of each: cause, what is left, next command."""

    def full(*given: object, **_: object) -> None:
        Path("loop_1").mkdir()
        raise OSError(errno.ENOSPC, "No space left on device", "file")

    monkeypatch.setattr("longarm_comp.jobs.client.ArmClient", MagicMock())
    monkeypatch.setattr(f"longarm_comp.{place}", full)
    assert shell(*(str(demo_arm_path) if word == "ARM" else word for word in words)) == 3
    *before, last = shell.err.splitlines()
    assert "No space left on device" in last and kept in " ".join(before)
