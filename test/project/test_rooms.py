"""Who may import whom: the rooms of the package, read from the source without running it."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import pytest
from places import ROOT
from source_tree import PACKAGE, ROS, Import, below, imports, known, sources

from longarm_comp.core.effects.catalogue import LIBRARY

IO = ("cv2", "serial", "click", "rich", "matplotlib")

# Imports point only upward in this list; modules of the core that it does not name are checked
# through whatever they import.
CORE_ORDER = (
    *("errors", "files", "strict_yaml", "yaml_file", "arm", "effects", "model"),
    *(
        "ik",
        "data",
        "compensation",
        "vibration",
        "learn",
        "calibration",
        "planning",
        "identify",
        "at_work",
    ),
)


@dataclass(frozen=True)
class Room:
    """What a folder of the package may import.

    Attributes:
        forbidden: rooms of the package, as paths below it, and outside packages.
        only: where set, the only parts of the package outside the room itself.
    """

    forbidden: tuple[str, ...] = ()
    only: tuple[str, ...] | None = None


ROOMS = {
    "math": Room((*ROS, *IO, "scipy"), only=()),
    "core": Room((*ROS, *IO), only=("math",)),
    "devices": Room(
        ROS,
        only=(
            *("core.entry_points", "core.errors", "core.files", "core.strict_yaml"),
            *("core.yaml_file", "math"),
        ),
    ),
    "sim": Room(
        ROS,
        only=(
            *("core.arm", "core.entry_points", "core.errors", "core.files", "core.strict_yaml"),
            "devices",
        ),
    ),
    "arm_folder": Room((*ROS, "click", "rich"), only=("core", "devices", "sim", "share")),
    "sessions": Room((*ROS, "nodes", "devices", "sim", "report", "workflows", "cli")),
    "report": Room((*ROS, "nodes", "devices", "sim", "workflows", "cli")),
    "workflows": Room((*ROS, "click", "rich"), only=("core", "sessions", "report", "version")),
    "nodes": Room(("cli", "report", "workflows", "scipy")),
    "view": Room(("click", "scipy"), only=("core", "nodes", "jobs.graph_client")),
}

MATHS = {
    *("linalg", "einsum", "matmul", "dot", "cross", "outer", "inv", "solve", "norm", "lstsq"),
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan2", "asin", "acos", "atan2", "hypot"),
}


def maths(source: str) -> Iterator[tuple[int, str]]:
    """Where a source text computes: linear algebra, trigonometry, matrix products."""
    for node in ast.walk(ast.parse(source)):
        named = isinstance(node, ast.Attribute) and node.attr in MATHS
        if named or (isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult)):
            yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.ImportFrom) and node.module in {"math", "numpy", "numpy.linalg"}:
            for alias in node.names:
                if alias.name in MATHS:
                    yield node.lineno, alias.name


def room_faults(room: str, file: str, found: list[Import], rule: Room | None = None) -> list[str]:
    """What a file imports against a rule, by default that of its room."""
    rule = rule or ROOMS[room]
    faults = []
    for entry in found:
        inside = entry.name.removeprefix(f"{PACKAGE}.")
        ours = inside != entry.name
        allowed = rule.only is None or not ours or below(inside, (room, *rule.only))
        if below(inside, rule.forbidden) or not allowed:
            faults.append(f"{file}:{entry.line}: {room} must not import {entry.name}")
    return faults


def order_faults(graph: dict[str, set[str]]) -> list[str]:
    """Modules of the core that reach, directly or through others, one lower in the list."""

    def rank(module: str) -> int | None:
        parts = module.split(".")
        named = len(parts) > 2 and parts[1] == "core" and parts[2] in CORE_ORDER
        return CORE_ORDER.index(parts[2]) if named else None

    faults = []
    for module in sorted(graph):
        own = rank(module)
        for reached in sorted(reach(graph, module)) if own is not None else ():
            other = rank(reached)
            if other is not None and own is not None and other > own:
                faults.append(f"{module} reaches {reached}, which stands below it")
    return faults


def reach(graph: dict[str, set[str]], start: str) -> set[str]:
    seen: set[str] = set()
    ahead = [start]
    while ahead:
        fresh = graph.get(ahead.pop(), set()) - seen
        seen |= fresh
        ahead += fresh
    return seen


@cache
def read(module: str) -> list[Import]:
    return list(imports(sources()[module].read_text("utf-8"), module, known()))


def in_room(room: str) -> list[str]:
    return [name for name in sources() if below(name, (f"{PACKAGE}.{room}",))]


@cache
def graph() -> dict[str, set[str]]:
    """The modules of package, benchmarks and studies, and what each needs of them.

    Imports within functions and for types alone count, except those of the package's own file,
    which names what it loads when it is asked for.
    """
    return {
        module.removesuffix(".__init__"): {
            entry.name for entry in read(module) if entry.name in known()
        }
        for module in sources()
        if module != f"{PACKAGE}.__init__"
    }


@pytest.mark.parametrize("room", ROOMS)
def test_room_imports_only_what_it_may(room: str) -> None:
    modules = in_room(room)
    faults = [fault for name in modules for fault in room_faults(room, name, read(name))]
    assert not faults, "\n".join(faults)


ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text("utf-8")


def stated() -> dict[str, Room]:
    """The rule of each folder, as the table of the architecture's page states it."""
    rules = {}
    rows = re.findall(r"^\| `(\w+)/` \| .* \| (.+?) \|$", ARCHITECTURE, re.MULTILINE)
    for folder, rule in rows:
        names = tuple(re.findall(r"`([\w.]+)`", rule))
        assert names or rule in ("nothing", "everything"), rule
        listed = rule != "everything" and not rule.startswith("not ")
        rules[folder] = Room(forbidden=() if listed else names, only=names if listed else None)
    return rules


@pytest.mark.parametrize("room", stated())
def test_a_folder_imports_what_the_page_of_the_architecture_states(room: str) -> None:
    faults = [
        fault
        for name in in_room(room)
        for fault in room_faults(room, name, read(name), stated()[room])
    ]
    assert not faults, "\n".join(faults)


def test_the_page_of_the_architecture_has_every_folder_and_the_order_of_the_core() -> None:
    folders = {path.parent.name for path in (ROOT / PACKAGE).glob("*/__init__.py")}
    assert set(stated()) == folders
    lines = re.findall(r"^- `core/([^`]+)`", ARCHITECTURE, re.MULTILINE)
    assert [line.strip("/") for line in lines[1:]] == list(CORE_ORDER[4:])


def test_core_imports_point_upward() -> None:
    assert {"longarm_comp.core.errors", "longarm_comp.core.files"} <= known()
    faults = order_faults(graph())
    assert not faults, "\n".join(faults)


def test_the_diagnosis_names_no_effect() -> None:
    """An effect of another package is searched for as ours are."""
    ours = {kind.__module__ for kind in LIBRARY}
    faults = [
        f"{module} imports {entry.name}"
        for module in sources()
        if module.startswith("longarm_comp.core.identify")
        for entry in read(module)
        if entry.name in ours
    ]
    assert len(LIBRARY) > 20 and faults == []


def test_no_module_imports_itself_through_others() -> None:
    loops = [module for module in graph() if module in reach(graph(), module)]
    assert not loops, f"import cycle through {loops}"


def test_no_two_classes_have_one_name() -> None:
    """The simulator is apart, whose hidden effects are called as the model's."""
    aside = (
        f"{PACKAGE}.sim",
        f"{PACKAGE}.core.effects.discovered",
        f"{PACKAGE}.core.effects.quantities",
    )
    where: dict[str, list[str]] = {}
    for module, path in sources().items():
        if below(module, (PACKAGE,)) and not below(module, aside):
            for node in ast.parse(path.read_text("utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    where.setdefault(node.name, []).append(module)
    assert not {name: modules for name, modules in where.items() if len(modules) > 1}


@pytest.mark.parametrize("room", ["nodes", "view"])
def test_nodes_and_the_page_hold_no_maths(room: str) -> None:
    found = [
        f"{name}:{line}: {what}"
        for name in in_room(room)
        for line, what in maths(sources()[name].read_text("utf-8"))
    ]
    assert not found, "\n".join(found)


ENTRANCES = (f"{PACKAGE}.__main__", "bench.command", "studies")


def test_only_the_entry_point_imports_the_command_line() -> None:
    callers = [
        name
        for name in sources()
        if not below(name, (f"{PACKAGE}.cli", f"{PACKAGE}.__main__", "bench.command", "studies"))
        and any(below(entry.name, (f"{PACKAGE}.cli",)) for entry in read(name))
    ]
    assert not callers


@pytest.mark.parametrize("folder", ["bench", "studies"])
def test_the_package_imports_nothing_that_is_not_installed(folder: str) -> None:
    callers = [
        name
        for name in sources()
        if below(name, (PACKAGE,)) and any(below(entry.name, (folder,)) for entry in read(name))
    ]
    assert not callers


@pytest.mark.parametrize(
    ("room", "source"),
    [
        ("core", "import rclpy"),
        ("math", "from longarm_comp.core.errors import InputError"),
        ("core", "def f():\n    from geometry_msgs.msg import Pose"),
        ("core", "from longarm_comp import sim"),
        ("core", "from ..nodes import kinematics"),
        ("devices", "from sensor_msgs.msg import Image"),
        ("devices", "from longarm_comp.core.model.model import Model"),
        ("sim", "from longarm_comp.core import posture"),
        ("sim", "from longarm_comp.core.effects.slow_changes import Creep"),
        ("sim", "import importlib\nimportlib.import_module('longarm_comp.core.ik.solver')"),
        ("nodes", "import scipy.linalg"),
        ("report", "from longarm_comp.nodes.kinematics import Kinematics"),
        ("workflows", "from longarm_comp.jobs.collect.run import collect"),
        ("workflows", "def f():\n    import click"),
        ("nodes", "from longarm_comp.workflows.train import train"),
        ("view", "from longarm_comp.sessions.csv import read_csv"),
    ],
)
def test_a_planted_import_is_found(room: str, source: str) -> None:
    modules = known() | {f"{PACKAGE}.{name}" for name in ("sim", "nodes", "core.posture")}
    found = list(imports(source, f"{PACKAGE}.{room}.planted", modules))
    assert len(room_faults(room, "planted", found)) == 1


def test_a_planted_detour_downward_is_found() -> None:
    core = f"{PACKAGE}.core"
    detour = {f"{core}.arm": {f"{core}.helper"}, f"{core}.helper": {f"{core}.effects.creep"}}
    assert order_faults(detour) == [
        f"{core}.arm reaches {core}.effects.creep, which stands below it"
    ]
    assert order_faults({f"{core}.ik": {f"{core}.effects.creep"}}) == []


@pytest.mark.parametrize(
    "source", ["np.linalg.inv(a)", "a @ b", "math.sin(q)", "from numpy import cross"]
)
def test_planted_maths_is_found(source: str) -> None:
    assert list(maths(source))
    assert not list(maths("error = measured - predicted\nmath.isfinite(error)"))
