"""What `make test` installs: as root, with sudo, with neither; and what it leaves out without."""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from browser import NEEDED, browser
from places import ROOT

SAYS = 'echo "$(basename $0) $*" >> {log}'


class Machine:
    """A machine by the programs on its path; those that install write down how they were called."""

    def __init__(self, folder: Path) -> None:
        self.path, self.log = folder / "bin", folder / "log"
        self.path.mkdir()
        for name in ("make", "sh", "basename", "env"):
            (self.path / name).symlink_to(shutil.which(name) or name)
        self.log.touch()

    def has(self, name: str, does: str = "true") -> None:
        file = self.path / name
        file.write_text(f"#!/bin/sh\n{SAYS.format(log=self.log)}\n{does}\n")
        file.chmod(0o755)

    def user(self, number: int) -> None:
        self.has("id", f"echo {number}")

    def make_browser(self) -> tuple[str, list[str]]:
        """What `make browser` prints, and the packages that were installed; it never fails."""
        done = subprocess.run(
            ["make", "-s", "-C", str(ROOT), "browser"],
            env={"PATH": str(self.path)}, capture_output=True, text=True, check=True,
        )  # fmt: skip
        calls = self.log.read_text().splitlines()
        return done.stdout, [c for c in calls if c.startswith("apt-get install")]


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    made = Machine(tmp_path)
    made.has("apt-get")
    return made


def test_root_gets_a_browser(machine: Machine) -> None:
    machine.user(0)
    said, installed = machine.make_browser()
    assert said == ""
    assert len(installed) == 1 and installed[0].endswith(" chromium")


@pytest.mark.parametrize("name", ["chromium", "google-chrome"])
def test_one_that_is_there_is_taken(machine: Machine, name: str) -> None:
    machine.user(0)
    machine.has(name)
    assert machine.make_browser() == ("", [])


def test_sudo_that_asks_for_nothing_is_used(machine: Machine) -> None:
    machine.user(1000)
    machine.has("sudo", 'shift; exec "$@"')
    said, installed = machine.make_browser()
    assert said == "" and len(installed) == 1


@pytest.mark.parametrize("sudo", ["", "exit 1"], ids=["no sudo", "sudo asks for a password"])
def test_who_may_not_install_is_told_in_one_line(machine: Machine, sudo: str) -> None:
    machine.user(1000)
    if sudo:
        machine.has("sudo", sudo)
    said, installed = machine.make_browser()
    assert installed == []
    assert said.count("\n") == 1 and "skipped" in said and "sudo make system" in said


def test_a_registry_out_of_reach_is_no_failure(machine: Machine) -> None:
    machine.user(0)
    machine.has("apt-get", "echo no network >&2; exit 100")
    said, _ = machine.make_browser()
    assert said.count("\n") == 1 and "skipped" in said


def test_a_worker_that_dies_ends_the_run_with_its_name(tmp_path: Path) -> None:
    """As the garbage collector died in one once, and the others waited for ever."""
    asks = "include Makefile\n$(info $(SPREAD))\nshown: ; @:"
    words = ["make", "-s", "-f", "-", "shown", "WORKERS=2"]
    options = subprocess.run(
        words, cwd=ROOT, input=asks, capture_output=True, text=True, check=True
    ).stdout
    for name in ("a", "b", "c"):
        (tmp_path / f"test_{name}.py").write_text("def test_one(): pass\ndef test_two(): pass\n")
    dies = "def test_dies():\n    import os\n    os.abort()\n"
    (tmp_path / "test_a.py").write_text(dies + (tmp_path / "test_b.py").read_text())
    run = [sys.executable, "-m", "pytest", *shlex.split(options), "-p", "no:cacheprovider"]
    ended = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 1, ended.stdout + ended.stderr
    assert "crashed while running 'test_a.py::test_dies'" in ended.stdout


def test_without_a_browser_a_page_is_skipped_or_fails_as_asked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for asked, outcome in (("", pytest.skip.Exception), ("needed", pytest.fail.Exception)):
        monkeypatch.setenv(NEEDED, asked)
        with pytest.raises(BaseException, match="sudo make system") as without:
            browser()
        assert without.type is outcome
