"""Every command of the pages, read from their text: it parses, its files exist, and walks run."""

import ast
import importlib
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import pytest
from cli_shell import ENTRIES, Shell, click_command
from openpyxl import Workbook
from page_lines import FENCE, lines
from places import ROOT
from scipy.spatial.transform import Rotation
from urdf_robots import example

import longarm_comp
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.effects import catalogue
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.plant import hidden_effects

DOCS = ROOT / "docs"
ORDER = ("README.md", "docs/start.md", "docs/your_own_arm.md", "docs/laser_tracker.md")
PAGES = (*ORDER, *sorted({p.relative_to(ROOT).as_posix() for p in DOCS.rglob("*.md")} - {*ORDER}))
YOURS = (
    *("arm.yaml", "robot.urdf", "samples.csv", "test.csv", "targets.csv", "tip.csv"),
    *("tracker.csv", "tracker.xlsx", "second.xlsx", "log.xlsx", "mocap.csv"),
    *("day1.csv", "day2.csv", "joints.csv", "tracker.txt"),
    *("DATA", "A", "B", "A.csv", "B.csv", "ARM", "DIAGNOSIS_A", "DIAGNOSIS_B"),
    *("diagnosis_1", "diagnosis_2"),
)
"""Files that a reader brings, or that stand for any file."""


@dataclass(frozen=True)
class Said:
    """One command of a page: where it stands, and its words after ``longarm``."""

    page: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: longarm {shlex.join(self.words)}"


def commands(page: str) -> Iterator[Said]:
    """The commands of longarm in a page's shell blocks."""
    for words in lines(page):
        if words[0].endswith("longarm"):
            yield Said(page, tuple(words[1:]))


def found(words: tuple[str, ...]) -> tuple[click.Command, list[str], str]:
    """The command of some words, its arguments, and its name."""
    for name in ENTRIES:
        first = name.split()
        if list(words[: len(first)]) == first:
            return click_command(name), list(words[len(first) :]), name
    raise AssertionError(f"no command: longarm {shlex.join(words)}")


def read_and_written(context: click.Context) -> tuple[list[Path], list[Path]]:
    """Files that a parsed command reads, and those that it writes."""
    reads: list[Path] = []
    writes: list[Path] = []
    for parameter in context.command.params:
        value = context.params.get(parameter.name or "")
        given = value if isinstance(value, tuple) else (value,)
        asked = context.get_parameter_source(parameter.name or "")
        new = parameter.name in ("output", "out", "picture", "log", "save", "frames")
        for path in given:
            if isinstance(path, Path) and asked is not click.core.ParameterSource.DEFAULT:
                (writes if new else reads).append(path)
    return reads, writes


@pytest.fixture
def no_effect_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalogue, "load_file", lambda file: None)
    monkeypatch.chdir(ROOT)


def test_every_command_of_the_pages_parses_and_names_files_that_are_there(
    no_effect_is_loaded: None,
) -> None:
    made: set[Path] = set()
    counted = 0
    for page, line in [(name, words) for name in PAGES for words in lines(name)]:
        if line[0].endswith("python"):
            if line[1] != "-m":
                assert (ROOT / line[1]).is_file(), f"{page}: {line[1]}"
                made |= {Path(word) for word in line[2:]}
            continue
        said = Said(page, tuple(line[1:]))
        command, words, name = found(said.words)
        try:
            context = command.make_context(name, words)
        except (click.ClickException, longarm_comp.InputError) as error:
            raise AssertionError(f"{said}: {error}") from error
        reads, writes = read_and_written(context)
        for path in reads:
            known = str(path) in YOURS or (ROOT / path).exists()
            assert known or made & {path, *path.parents}, f"{said}: nothing made {path}"
        made |= {*writes}
        if name == "up":  # files that it waits for
            made |= {Path("model.yaml"), Path("predictor.npz")}
        counted += 1
    assert counted > 50


def test_python_of_the_pages_compiles_and_names_what_there_is() -> None:
    for page in PAGES:
        for language, block in FENCE.findall((ROOT / page).read_text("utf-8")):
            if language != "python":
                continue
            tree = ast.parse(block)
            for node in ast.walk(tree):
                if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "la":
                    assert hasattr(longarm_comp, node.attr), f"{page}: la.{node.attr}"
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("longarm"):
                    module = importlib.import_module(node.module or "")
                    for name in (alias.name for alias in node.names):
                        if not hasattr(module, name):
                            importlib.import_module(f"{module.__name__}.{name}")


# ------------------------------------------------------------------ walks

BOOM = """<robot name="boom">
  <link name="chassis"/>
  <link name="turret"><inertial><origin xyz="0 0 .2"/><mass value="8"/>{i}</inertial></link>
  <link name="boom"><inertial><origin xyz=".8 0 0"/><mass value="6.5"/>{i}</inertial></link>
  <link name="stage"><inertial><origin xyz="-.4 0 0"/><mass value="2.4"/>{i}</inertial></link>
  <link name="jib"><inertial><origin xyz=".3 0 0"/><mass value="1.1"/>{i}</inertial></link>
  <link name="head"/>
  <joint name="slew" type="revolute"><parent link="chassis"/><child link="turret"/>
    <origin xyz="0 0 .4"/><axis xyz="0 0 1"/><limit lower="-3.1" upper="3.1" {e}/></joint>
  <joint name="luff" type="revolute"><parent link="turret"/><child link="boom"/>
    <origin xyz=".05 0 .3"/><axis xyz="0 -1 0"/><limit lower="-.2" upper="1.2" {e}/></joint>
  <joint name="extend" type="prismatic"><parent link="boom"/><child link="stage"/>
    <origin xyz="1.6 0 0"/><axis xyz="1 0 0"/><limit lower="0" upper=".9" {e}/></joint>
  <joint name="knuckle" type="revolute"><parent link="stage"/><child link="jib"/>
    <origin xyz=".1 0 0"/><axis xyz="0 -1 0"/><limit lower="-1.5" upper="1.5" {e}/></joint>
  <joint name="nose" type="fixed"><parent link="jib"/><child link="head"/>
    <origin xyz=".7 0 .02"/></joint>
</robot>""".format(
    i='<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>', e='effort="100" velocity=".5"'
)


def tracked(arm: Arm, count: int, path: Path, seed: int) -> np.ndarray:
    """A tracker's workbook of a boom whose joints give way: deg and mm, the tracker's own frame."""
    rng = np.random.default_rng(4)
    sizes = {"joint_compliance": 9.0, "joint_zero": 8.0, "dh_error": 3.0}
    real = TrueArm(arm, hidden_effects(arm, sizes, rng))
    q = sobol(arm, count, seed).q
    turn = Rotation.from_euler("zyx", [37.0, 1.2, -0.6], degrees=True)
    seen = turn.apply(real.tip(q)) + np.array([2.1, -3.4, 0.8]) + rng.normal(0.0, 5e-5, (count, 3))
    sheet = (book := Workbook()).active
    assert sheet is not None
    sheet.append(["Boom, tracker 1"])
    sheet.append([])
    sheet.append(["No.", "Slew", "Luff", "Extend", "Knuckle", "X", "Y", "Z"])
    sheet.append(["", "deg", "deg", "mm", "deg", "mm", "mm", "mm"])
    per = np.array([180 / np.pi, 180 / np.pi, 1e3, 180 / np.pi])
    for k in range(count):
        sheet.append([k + 1, *(q[k] * per).round(4).tolist(), *(1e3 * seen[k]).round(3).tolist()])
    book.save(path)
    return seen


@pytest.mark.usefixtures("few_names")
def test_the_walk_with_a_boom_and_a_tracker_runs_as_it_is_written(shell: Shell) -> None:
    Path("robot.urdf").write_text(BOOM)
    for said in commands("docs/laser_tracker.md"):
        assert shell(*said.words) == 0, f"{said}\n{shell.err}"
        if said.words[0] == "init":
            arm = Arm.load("boom/arm.yaml")
            seen = tracked(arm, 100, Path("tracker.xlsx"), 7)
            tracked(arm, 20, Path("second.xlsx"), 9)
            rows = "\n".join(",".join(map(str, row)) for row in seen[:3].round(3))
            Path("targets.csv").write_text(f"x,y,z\n{rows}\n")
    assert said.words[0] == "evaluate"
    last = [line for line in shell.out.splitlines() if "calibrated" in line]
    assert float(last[0].split("│")[3]) < 0.2  # mean, mm; 5 mm before
    assert (Path("boom") / "diagnosis" / "report.html").is_file()
    assert "<robot" in Path("boom/calibrated.urdf").read_text()


def test_the_start_page_runs_as_it_is_written(shell: Shell, ros_domain: int) -> None:
    shutil.copy(example("ur_description/urdf/ur5_robot.urdf"), "robot.urdf")
    for said in commands("docs/start.md"):
        if said.words[0] != "up":
            assert shell(*said.words) == 0, f"{said}\n{shell.err}"
            continue
        words = [sys.executable, "-m", "longarm_comp", *said.words]
        with subprocess.Popen(words, text=True, stderr=subprocess.PIPE) as graph:
            assert graph.stderr is not None
            said_so = next((line for line in graph.stderr if "are starting" in line), "")
            graph.terminate()
            graph.stderr.read()
        assert said_so and graph.returncode == 0
