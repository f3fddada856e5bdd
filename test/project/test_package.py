"""The package as it is installed: nothing left out, nothing undeclared, one version."""

import ast
import email
import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zipfile
from functools import cache
from importlib.metadata import entry_points, packages_distributions
from pathlib import Path

import pytest
import source_tree
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from places import ROOT
from session_bag import write_bag
from small_arm import ARM

import longarm_comp
from longarm_comp import libraries
from longarm_comp.sessions.csv import read_csv

PACKAGE = source_tree.PACKAGE

# Programs that run in an environment of their own, because theirs and ours exclude each other.
ELSEWHERE = {"mealpy", "pybotics"}

PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]


# Modules that cmeel keeps in a prefix of its own, which Python's metadata does not name.
PREFIXED = {"pinocchio": {"pin"}, "roboplan": {"roboplan"}}


def declared(wheel: Path, *, extras: bool) -> set[str]:
    """Distributions that a wheel asks for, with or without its extras."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        lines = email.message_from_bytes(archive.read(name)).get_all("Requires-Dist", [])
    return {
        canonicalize_name(entry.name)
        for entry in map(Requirement, lines)
        if extras or "extra" not in str(entry.marker or "")
    }


def ros_depends() -> set[str]:
    tree = ElementTree.parse(ROOT / "package.xml")
    return {element.text or "" for element in tree.iter() if element.tag.endswith("depend")}


def outside_imports(folder: Path) -> dict[str, set[str]]:
    """Top-level names imported from outside this repository -> the files that import them."""
    found: dict[str, set[str]] = {}
    scripts = ("test/support", "examples", "docs/made_by")
    beside = (file.stem for name in scripts for file in (ROOT / name).glob("*.py"))
    own = {PACKAGE, "bench", "studies", "soak", *beside}
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
    if sys.version_info < (3, 11):
        pytest.skip("before Python 3.11, not every installed distribution tells its modules")
    installed = packages_distributions()
    return {module: set(map(canonicalize_name, names)) for module, names in installed.items()}


def distributions(top_level: str, allowed: set[str] = frozenset()) -> set[str]:
    """What brings a module; of a peer that only `make bench` installs, what is named like it."""
    brought = providers().get(top_level, set()) | PREFIXED.get(top_level, set())
    like = canonicalize_name(top_level)
    return brought or {name for name in allowed if name == like or name.startswith(f"{like}-")}


@pytest.mark.parametrize(
    "folder", [PACKAGE, "bench", "studies", "test", "examples", "docs/made_by"]
)
def test_every_import_is_declared(folder: str, wheel: Path) -> None:
    allowed = declared(wheel, extras=True)
    undeclared = {
        name: sorted(files)
        for name, files in outside_imports(ROOT / folder).items()
        if name not in ros_depends() | ELSEWHERE and not distributions(name, allowed) & allowed
    }
    assert not undeclared, f"not in setup.py or package.xml: {undeclared}"


OF_EXTRAS = ("view/", "core/compensation/planned_path.py", "workflows/cluster.py")
WITH_EXTRAS = tuple(f"{PACKAGE}/{name}" for name in OF_EXTRAS)


def test_what_is_installed_with_the_package_is_what_it_uses_outside_of_extras(wheel: Path) -> None:
    found = outside_imports(ROOT / PACKAGE)
    needed = {
        name: distributions(name)
        for name, files in found.items()
        if any(not file.startswith(WITH_EXTRAS) for file in files) and name not in ros_depends()
    }
    runtime = declared(wheel, extras=False)
    assert not {name for name, brought in needed.items() if not brought & runtime}
    through_pandas = {"openpyxl"}  # its engine for XLSX
    assert not runtime - set().union(*needed.values()) - through_pandas
    assert not {"scikit-learn", "joblib", "dask", "viser", "websockets"} & runtime


LACKS = {
    "sklearn": ("study table1 --arms 1 -o out", "this study needs sklearn: {}[studies]'"),
    "joblib": ("study loop -o out", "this study needs joblib: {}[studies]'"),
    "viser": ("view --no-open", "longarm view needs viser: {}[view]'"),
}


def test_a_command_says_which_library_it_lacks(tmp_path: Path) -> None:
    code = """
import contextlib, io, json, sys
from longarm_comp.cli.run import run
for library, (words, _) in json.loads(sys.argv[1]).items():
    there = {n: sys.modules.pop(n) for n in [*sys.modules] if n.split(".")[0] == library}
    sys.modules[library] = None
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = run(words.split())
    del sys.modules[library]
    sys.modules |= there
    print(json.dumps([code, said.getvalue()]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(LACKS)],
        capture_output=True, text=True, cwd=tmp_path, check=True,
    )  # fmt: skip
    for (_, lacks), line in zip(LACKS.values(), done.stdout.splitlines(), strict=True):
        code, said = json.loads(line)
        assert code == 3
        assert lacks.format("pip install 'longarm_comp") in said
        assert "Traceback" not in said


def test_the_least_versions_are_those_that_pip_installs(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        lines = email.message_from_bytes(archive.read(name)).get_all("Requires-Dist", [])
    assert {wanted for wanted, _ in libraries.NEEDED.values()} <= set(lines)


def test_console_scripts_lead_somewhere() -> None:
    """Each script's module defines what it calls, and each node with a main has a script."""
    scripts = {
        entry.value
        for entry in entry_points(group="console_scripts")
        if entry.value.startswith(f"{PACKAGE}.")
    }
    mains = {
        f"{module.removesuffix('.__init__')}:main"
        for module, file in source_tree.sources().items()
        if source_tree.below(module, (f"{PACKAGE}.nodes", f"{PACKAGE}.cli"))
        and re.search(r"^(def main\(|main = )", file.read_text("utf-8"), re.MULTILINE)
    }
    assert scripts == mains | {f"{PACKAGE}.cli:main"}
    assert f"{PACKAGE}.cli" in source_tree.known()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of a copy of every tracked file."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in tracked("."):
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "source" / name).write_bytes((ROOT / name).read_bytes())
    command = [*PIP, "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", folder, "."]
    subprocess.run(command, cwd=folder / "source", check=True)
    (made,) = folder.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def prefix(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A prefix with the wheel installed below it."""
    folder = tmp_path_factory.mktemp("prefix")
    options = ["--quiet", "--no-compile", "--no-deps", "--ignore-installed", "--prefix", folder]
    subprocess.run([*PIP, "install", *options, wheel], check=True)
    return folder


def tracked(folder: str) -> list[str]:
    """Names of the files that belong to the project, below a folder of it."""
    command = ["git", "ls-files", folder]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode or not listed.stdout:
        pytest.skip("not a git checkout: the list of files is unknown")
    return [name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]


def test_wheel_holds_every_file_of_the_package_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    files = set(tracked(PACKAGE))
    assert files <= held, f"left out of the wheel: {sorted(files - held)}"
    folders = {name.split("/")[0] for name in held}
    assert {name for name in folders if not name.startswith(f"{PACKAGE}-")} == {PACKAGE}


@pytest.mark.long
def test_what_is_released_runs_the_demonstration_without_the_checkout(
    wheel: Path, tmp_path: Path
) -> None:
    """`python -m build`: a source distribution, and the wheel that is built of that."""
    words = [sys.executable, "-m", "build", "--no-isolation", "-o", str(tmp_path / "dist"), "."]
    subprocess.run(words, cwd=wheel.parent / "source", check=True, capture_output=True)
    (sdist,) = (tmp_path / "dist").glob("*.tar.gz")
    (again,) = (tmp_path / "dist").glob("*.whl")
    assert again.name == wheel.name and sdist.name.startswith(f"{PACKAGE}-")
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(again) as two:
        assert set(one.namelist()) == set(two.namelist())
    for name, what in (("of_sdist", sdist), ("of_wheel", again)):
        prefix = tmp_path / name
        options = ["--quiet", "--no-deps", "--no-build-isolation", "--ignore-installed"]
        subprocess.run([*PIP, "install", *options, "--prefix", prefix, what], check=True)
        finds_its_own_files(prefix)
    longarm = prefix / "bin" / "longarm"
    done = below(prefix, longarm, "demo", "--out", tmp_path / "demo")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "demo" / "report.html").is_file()


WITHOUT_ROS = """
import contextlib, importlib.abc, io, json, sys
ros = set(sys.argv[1].split())
class Bare(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ros:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Bare())
from longarm_comp.cli.run import run
done = []
for words in json.loads(sys.argv[2]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(words)
    done.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(done))
"""


def test_without_ros_files_are_worked_on_and_the_rest_says_what_it_lacks(
    prefix: Path, work: Path, tmp_path: Path
) -> None:
    """The installed wheel, where nothing of ROS can be imported."""
    ros = " ".join(ros_depends() | set(source_tree.ROS))

    arm, session = work / "arm.yaml", work / "samples.csv"
    write_bag(read_csv(session, ARM), tmp_path / "bag", ARM)
    works = (
        ("--version",),
        ("init", tmp_path / "mine", "--arm", arm),
        ("plan", arm, "--kind", "sobol", "-n", 8, "-o", tmp_path / "poses.csv"),
        ("evaluate", arm, "--test", tmp_path / "bag", "--model", work / "model.yaml"),
        ("bag", "to-csv", arm, tmp_path / "bag", "-o", tmp_path / "back.csv"),
    )
    lacks = (
        ("up", arm, "--sim"),
        ("collect", arm, tmp_path / "poses.csv", "-o", tmp_path / "session"),
        ("demo", "--out", tmp_path / "demo"),
    )
    asked = json.dumps([[*map(str, words)] for words in (*works, *lacks)])
    made = below(prefix, sys.executable, "-c", WITHOUT_ROS, ros, asked)
    assert made.returncode == 0, made.stderr
    done = json.loads(made.stdout)
    assert done[0][1] == f"longarm, version {longarm_comp.__version__}\n"
    assert [code for code, *_ in done] == [0] * len(works) + [3] * len(lacks), done
    for _, _, said in done[len(works) :]:
        assert said.startswith("longarm: this command needs ROS 2 (")
        assert len(said.splitlines()) == 1
    assert not (tmp_path / "session").exists() and not (tmp_path / "demo").exists()


FIND_SHARES = """
import json, longarm_comp
from pathlib import Path
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.sessions.message_types import interface_files
from longarm_comp.share import folder
graph = BringUp(arm=folder("config") / "arm_demo.yaml", sim=True)
print(json.dumps({
    "package": longarm_comp.__file__,
    "nodes": [str(graph.file(node)) for node in graph.nodes],
    "launch": str(folder("launch")),
    "interfaces": [str(path) for path in interface_files()],
}))
"""


def below(prefix: Path, *command: object) -> subprocess.CompletedProcess[str]:
    """A command with the installation below a prefix, run from that folder."""
    (packages,) = prefix.glob("**/site-packages")
    environment = os.environ | {"PYTHONPATH": str(packages)}
    words = [*map(str, command)]
    return subprocess.run(words, cwd=prefix, env=environment, capture_output=True, text=True)


def finds_its_own_files(prefix: Path) -> None:
    """Package, config and launch of a prefix, with another installation beside it."""
    done = below(prefix, sys.executable, "-c", FIND_SHARES)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert prefix in Path(found["package"]).parents
    share = prefix / "share" / PACKAGE
    assert Path(found["launch"]) == share / "launch"
    for folder in ("config", "launch"):
        files = [f for f in (share / folder).rglob("*.*") if f.parent.name != "__pycache__"]
        assert set(tracked(folder)) == {str(file.relative_to(share)) for file in files}
    assert len(found["nodes"]) == 5
    assert all(Path(file).is_file() and share in Path(file).parents for file in found["nodes"])
    assert found["interfaces"]


def test_an_installation_below_any_prefix_finds_its_own_files(prefix: Path) -> None:
    finds_its_own_files(prefix)
    programs = prefix / "lib" / PACKAGE  # where `ros2 run` and `ros2 launch` look
    assert {p.name for p in programs.iterdir()} == {p.name for p in (prefix / "bin").iterdir()}
    longarm = programs / "longarm"
    assert "--sim" in below(prefix, longarm, "up", "--help").stdout
    for folder, words in (("bench", ["bench"]), ("studies", ["study", "loop"])):
        refused = below(prefix, longarm, *words)
        assert refused.returncode == 3
        assert (
            refused.stderr == f"longarm: {folder} can only be run from a checkout of the project\n"
        )


def test_an_installed_graph_comes_up_and_ends_as_it_is_told(prefix: Path, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
    from nodes_bench import bench, children, gone
    from own_graph import own_graph

    from longarm_comp.nodes import interfaces as graph

    (packages,) = prefix.glob("**/site-packages")
    arm = prefix / "share" / PACKAGE / "config" / "arm_demo.yaml"
    with own_graph(tmp_path), bench() as stage:
        words = [str(prefix / "bin" / "longarm"), "up", str(arm), "--sim", "--namespace", "arm"]
        program = stage.program(words, packages, tmp_path)
        joints = stage.collect(graph.JOINT_STATES, "arm")
        tips = stage.collect(graph.TIP_MEASURED, "arm")
        stage.spin(lambda: joints and tips)
        pids = children(program)
        assert len(pids) == 5
        for pid in pids:
            words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
            assert str(prefix) in " ".join(words)  # its parameter file is the installed one
        program.terminate()
        assert program.wait(timeout=300) == 0
        assert all(map(gone, pids))


@pytest.mark.long
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
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    assert (index / PACKAGE).is_file()
    finds_its_own_files(prefix)
