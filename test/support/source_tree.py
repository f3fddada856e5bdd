"""The modules of package, benchmarks and studies and what they import, without running them."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from places import ROOT

PACKAGE = "longarm_comp"
ROS = (
    *("rclpy", "launch", "launch_ros", "longarm_interfaces", "tf2_ros", "ament_index_python"),
    *("builtin_interfaces", "rcl_interfaces", "rosgraph_msgs", "std_srvs", "std_msgs"),
    *("diagnostic_msgs", "geometry_msgs", "lifecycle_msgs", "sensor_msgs", "trajectory_msgs"),
    *("visualization_msgs", "nav_msgs", "action_msgs", "tf2_msgs", "control_msgs"),
)


@dataclass(frozen=True)
class Import:
    """One import, for types alone too: where, of what, whether within a function."""

    line: int
    name: str


def below(name: str, parents: tuple[str, ...]) -> bool:
    """Whether a dotted name is one of the parents or lies inside one."""
    return any(name == parent or name.startswith(f"{parent}.") for parent in parents)


def imports(source: str, module: str, known: frozenset[str]) -> Iterator[Import]:
    """Every import of a source text, nested ones too, as full names.

    ``from a import b`` gives ``a.b`` where that is a known module and ``a`` otherwise. ``module``
    ends in ``.__init__`` for a package's own file, so that relative imports come out right.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join([*module.split(".")[: -node.level], *filter(None, [base])])
            full = [f"{base}.{alias.name}" for alias in node.names]
            names = sorted({name if name in known else base for name in full})
        elif isinstance(node, ast.Call) and called(node.func) == "import_module":
            constants = (a.value for a in node.args if isinstance(a, ast.Constant))
            names = [value for value in constants if isinstance(value, str)]
        for name in names:
            yield Import(getattr(node, "lineno", 0), name)


def called(function: ast.expr) -> str:
    """Last name of what is called."""
    return str(getattr(function, "attr", getattr(function, "id", "")))


@cache
def sources() -> dict[str, Path]:
    """Module name -> file; a package's own file under ``name.__init__``."""
    files = [
        file for folder in (PACKAGE, "bench", "studies") for file in (ROOT / folder).rglob("*.py")
    ]
    return {".".join(file.relative_to(ROOT).with_suffix("").parts): file for file in sorted(files)}


@cache
def known() -> frozenset[str]:
    return frozenset(module.removesuffix(".__init__") for module in sources())
