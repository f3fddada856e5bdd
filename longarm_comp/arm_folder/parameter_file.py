"""ROS parameter files: read flat, and written from the package's own with other values.

A written file keeps the comment of every parameter, because it is the package's with other values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from longarm_comp.arm_folder.yaml_edit import edited, ros_path
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import parse_yaml, read_yaml
from longarm_comp.share import folder


def own_text(node: str) -> str:
    """Text of the package's own parameter file of a node."""
    return (folder("config") / f"{node}.yaml").read_text("utf-8")


def read_parameters(path: Path) -> dict[str, Any]:
    """Values by dotted name of a ROS parameter file."""
    return _flat(ros_parameters(read_yaml(path), path))


def parameters_of(node: str, file: Path) -> dict[str, Any]:
    """Values of a node that runs with a file: the package's own where the file has none."""
    given = read_parameters(file)
    for name, value, allowed in strangers(node, given):
        raise InputError(file, name, value, allowed)
    return own_parameters(node) | given


def strangers(node: str, given: Mapping[str, Any]) -> Iterator[tuple[str, Any, str]]:
    """(name, value, what is allowed) of what the node does not have, or of another kind."""
    known = own_parameters(node)
    for name, value in given.items():
        if name not in known:
            yield name, value, f"one of {', '.join(known)}"
        elif (kind := _kind(known[name])) not in (_kind(value), _kind(value).replace("whole ", "")):
            yield name, value, f"{kind}, for instance {known[name]!r}"


def _kind(value: Any) -> str:
    if isinstance(value, list):
        numbers = all(_kind(v).endswith("number") for v in value)
        return f"{len(value)} numbers" if numbers else "a list"
    if isinstance(value, bool):
        return "true or false"
    if isinstance(value, int):
        return "a whole number"
    return "a number" if isinstance(value, float) else "nothing" if value is None else "text"


def own_parameters(node: str) -> dict[str, Any]:
    """Values by dotted name of the package's own file of a node."""
    return _flat(ros_parameters(parse_yaml(own_text(node), node), node))


def ros_parameters(data: Any, where: object) -> dict[str, Any]:
    """The section ``ros__parameters`` of a parsed parameter file."""
    for node in data.values() if isinstance(data, dict) else ():
        if isinstance(node, dict) and isinstance(node.get("ros__parameters"), dict):
            return dict(node["ros__parameters"])
    raise InputError(where, "ros__parameters", "missing", "a ROS 2 parameter file")


def with_values(node: str, values: Mapping[str, Any], head: str) -> str:
    """The package's own file of a node with other values; comments of parameters are kept.

    Args:
        values: by dotted name. A mapping replaces a whole section.
        head: comment on top, instead of the file's own.
    """
    text = own_text(node)
    first = next(line for line in text.splitlines() if not line.startswith("#"))
    own = text[text.index(first) :]
    root, known = ros_path(own), own_parameters(node)
    lacking = [name for name in values if not any(f"{k}.".startswith(f"{name}.") for k in known)]
    if lacking:
        raise ValueError(f"{node}.yaml has no {', '.join(lacking)}")
    made = edited(own, {(*root, *name.split(".")): v for name, v in values.items()}, node)
    return "".join(f"# {line}".rstrip() + "\n" for line in head.splitlines()) + made


def one_line(value: Any) -> str:
    """A value as YAML on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6)
    return text.removesuffix("...\n").strip()


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        flat |= _flat(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat
