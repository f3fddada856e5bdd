"""The package as it is installed: nothing left out, nothing undeclared, one version."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zipfile
from functools import cache
from importlib.metadata import entry_points, packages_distributions, requires
from pathlib import Path

import pytest
import test_rooms
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import longarm_comp

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "longarm_comp"

# Programs that run in an environment of their own, because theirs and ours exclude each other.
ELSEWHERE = {"mealpy", "pybotics"}


# Modules that cmeel keeps in a prefix of its own, which Python's metadata does not name.
PREFIXED = {"pinocchio": {"pin"}, "roboplan": {"roboplan"}}


def declared(*, extras: bool) -> set[str]:
    """Distributions that setup.py names, with or without its extras."""
    named = [Requirement(line) for line in requires(PACKAGE) or []]
    return {
        canonicalize_name(entry.name)
        for entry in named
        if extras or "extra" not in str(entry.marker or "")
    }


def ros_depends() -> set[str]:
    tree = ElementTree.parse(ROOT / "package.xml")
    return {element.text or "" for element in tree.iter() if element.tag.endswith("depend")}


def outside_imports(folder: Path) -> dict[str, set[str]]:
    """Top-level names imported from outside this repository -> the files that import them."""
    found: dict[str, set[str]] = {}
    own = {PACKAGE, *(file.stem for file in (ROOT / "test").glob("*.py"))}
    for file in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
                names = [node.module]
            for name in {name.split(".")[0] for name in names} - own - sys.stdlib_module_names:
                found.setdefault(name, set()).add(str(file.relative_to(ROOT)))
    return found


@cache
def providers() -> dict[str, set[str]]:
    """Top-level module -> the installed distributions that bring it."""
    installed = packages_distributions()
    return {module: set(map(canonicalize_name, names)) for module, names in installed.items()}


def distributions(top_level: str) -> set[str]:
    return providers().get(top_level, set()) | PREFIXED.get(top_level, set())


@pytest.mark.parametrize("folder", [PACKAGE, "test", "examples"])
def test_every_import_is_declared(folder: str) -> None:
    allowed = declared(extras=True)
    undeclared = {
        name: sorted(files)
        for name, files in outside_imports(ROOT / folder).items()
        if name not in ros_depends() | ELSEWHERE and not distributions(name) & allowed
    }
    assert not undeclared, f"not in setup.py or package.xml: {undeclared}"


def test_every_runtime_dependency_is_used() -> None:
    used = set().union(*(distributions(name) for name in outside_imports(ROOT / PACKAGE)))
    assert not declared(extras=False) - used


def test_versions_agree() -> None:
    written = {
        ElementTree.parse(ROOT / "package.xml").findtext("version"),
        ElementTree.parse(ROOT / "longarm_interfaces" / "package.xml").findtext("version"),
        re.search(r'version="([^"]+)"', (ROOT / "setup.py").read_text("utf-8"))[1],
        re.search(r'version = "([^"]+)"', (ROOT / "longarm_interfaces/pyproject.toml").read_text())[
            1
        ],
    }
    assert written == {longarm_comp.__version__}


def test_console_scripts_lead_somewhere() -> None:
    """Each script's module defines what it calls, and each node with a main has a script."""
    scripts = {
        entry.value
        for entry in entry_points(group="console_scripts")
        if entry.value.startswith(f"{PACKAGE}.")
    }
    mains = {
        f"{module.removesuffix('.__init__')}:main"
        for module, file in test_rooms.sources().items()
        if test_rooms.below(module, (f"{PACKAGE}.nodes", f"{PACKAGE}.cli"))
        and re.search(r"^def main\(", file.read_text("utf-8"), re.MULTILINE)
    }
    assert scripts == mains | {f"{PACKAGE}.cli:main"}
    assert f"{PACKAGE}.cli" in test_rooms.known()


def test_wheel_holds_every_file_of_the_package(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    tracked = subprocess.run(
        ["git", "ls-files", PACKAGE], cwd=ROOT, capture_output=True, text=True, check=False
    )
    files = tracked.stdout.split()
    if tracked.returncode or not files:
        pytest.skip("not a git checkout: the list of files is unknown")
    copy = tmp_path / "source"
    for name in [*files, "setup.py", "setup.cfg", "pyproject.toml", "package.xml"]:
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_bytes((ROOT / name).read_bytes())
    (copy / "resource").mkdir()
    (copy / "resource" / PACKAGE).touch()
    subprocess.run([*command, "--wheel-dir", tmp_path, "."], cwd=copy, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    assert set(files) <= held, f"left out of the wheel: {sorted(set(files) - held)}"


def test_colcon_installs_what_ros2_run_and_launch_look_for(tmp_path: Path) -> None:
    colcon = Path(sys.executable).with_name("colcon")
    if not colcon.exists():
        pytest.skip("colcon is not installed: run make setup")
    path = f"{colcon.parent}{os.pathsep}{os.environ.get('PATH', '')}"
    environment = os.environ | {"PATH": path, "COLCON_HOME": str(tmp_path / "home")}
    install = tmp_path / "install"

    def run_colcon(*arguments: object) -> str:
        command = [colcon, "--log-base", tmp_path / "log", *map(str, arguments)]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    listed = run_colcon("list", "--names-only")
    assert set(listed.split()) == {PACKAGE, "longarm_interfaces"}
    run_colcon(
        "build", "--base-paths", ".", "--build-base", tmp_path / "build", "--install-base", install
    )
    prefix = install / PACKAGE
    scripts = {
        entry.name for entry in entry_points(group="console_scripts") if PACKAGE in entry.value
    }
    assert scripts <= {file.name for file in (prefix / "lib" / PACKAGE).iterdir()}
    share = prefix / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / PACKAGE).is_file()
    for folder, pattern in {"config": "*", "launch": "*.launch.py"}.items():
        for file in (ROOT / folder).glob(pattern):
            assert (share / PACKAGE / folder / file.name).is_file()
