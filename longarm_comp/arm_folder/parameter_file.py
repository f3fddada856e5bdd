"""Reads ROS parameter files by dotted name, and writes the package's own with other values.

When values in the text of a YAML file are replaced, its comments and order are kept.
"""

import io
import operator
from collections.abc import Iterator, Mapping
from functools import reduce
from pathlib import Path
from typing import Any

import yaml
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.util import load_yaml_guess_indent

from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import parse_yaml, read_yaml
from longarm_comp.share import folder

Keys = tuple[str, ...]
_ROS_OWN = ("use_sim_time", "start_type_description_service", "qos_overrides")
"""Parameters that ROS gives every node."""


def own_text(node: str) -> str:
    return (folder("config") / f"{node}.yaml").read_text("utf-8")


def read_parameters(path: Path) -> dict[str, Any]:
    """Read the values of a ROS parameter file, by dotted name."""
    return _flatten_tree(ros_parameters(read_yaml(path), path))


def parse_parameters(text: str, where: str) -> dict[str, Any]:
    """Return the values in the text of a ROS parameter file, by dotted name."""
    return _flatten_tree(ros_parameters(parse_yaml(text, where), where))


def parameters_of(node: str, file: Path) -> dict[str, Any]:
    """Return all parameters of a node that runs with a file, by dotted name.

    Parameters that the file lacks have the values of the package's own file.

    Raises:
        InputError: the file has a parameter that the node lacks, or one of another type.
    """
    known, given = own_parameters(node), read_parameters(file)
    for name, value, allowed in find_strangers(known, given):
        raise InputError(file, name, value, allowed)
    return known | given


def find_strangers(
    known: Mapping[str, Any], given: Mapping[str, Any]
) -> Iterator[tuple[str, Any, str]]:
    """Yield name, value and allowed values of parameters that a node cannot have.

    None of its `known` parameters has this name, or the one that has it is of another type.
    """
    for name, value in given.items():
        if name.partition(".")[0] in _ROS_OWN:
            continue
        if name not in known:
            yield name, value, f"one of {', '.join(known)}"
        elif (kind := _kind_of(known[name])) not in (
            _kind_of(value),
            _kind_of(value).replace("whole ", ""),
        ):
            yield name, value, f"{kind}, for instance {known[name]!r}"


def _kind_of(value: Any) -> str:
    if isinstance(value, list):
        numbers = all(_kind_of(v).endswith("number") for v in value)
        return f"{len(value)} numbers" if numbers else "a list"
    if isinstance(value, bool):
        return "true or false"
    if isinstance(value, int):
        return "a whole number"
    return "a number" if isinstance(value, float) else "nothing" if value is None else "text"


def own_parameters(node: str) -> dict[str, Any]:
    """Read the values of the package's own file of a node, by dotted name."""
    return parse_parameters(own_text(node), node)


def ros_parameters(data: Any, where: object) -> dict[str, Any]:
    """Return the section ``ros__parameters`` of parsed YAML. Raises InputError without one."""
    for node in data.values() if isinstance(data, dict) else ():
        if isinstance(node, dict) and isinstance(node.get("ros__parameters"), dict):
            return dict(node["ros__parameters"])
    raise InputError(where, "ros__parameters", "missing", "a ROS 2 parameter file")


def with_values(node: str, values: Mapping[str, Any], head: str) -> str:
    """Return the package's own file of a node with other values; comments of parameters are kept.

    Args:
        values: new values by dotted name; a mapping replaces a whole section.
        head: the comment on top.
    """
    text = own_text(node)
    first = next(line for line in text.splitlines() if not line.startswith("#"))
    own = text[text.index(first) :]
    made = edit_text(own, {tuple(name.split(".")): v for name, v in values.items()}, node)
    return "".join(f"# {line}".rstrip() + "\n" for line in head.splitlines()) + made


def one_line(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6)
    return text.removesuffix("...\n").strip()


def _flatten_tree(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        flat |= _flatten_tree(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def edit_text(text: str, values: Mapping[Keys, Any], where: object) -> str:
    """Return a YAML text with new values; comments and order are kept.

    A missing key is added at the end of its section. A mapping is written as a block of lines, a
    list on one line.

    Args:
        values: new values by their path of keys, which starts below ``ros__parameters`` if the text
            has that.

    Raises:
        InputError: a section on the path is missing, or a value cannot be edited.
    """
    data = parse_yaml(text, str(where))
    for key, node in data.items() if isinstance(data, dict) else ():
        if isinstance(node, dict) and "ros__parameters" in node:
            values = {(str(key), "ros__parameters", *path): v for path, v in values.items()}
            break
    writer = YAML()
    writer.preserve_quotes, writer.width = True, 10**6
    root = writer.load(text)
    if not isinstance(root, CommentedMap):
        found = "nothing" if root is None else type(root).__name__
        raise InputError(where, "document", found, "a mapping of keys")
    _, indent, before_dash = load_yaml_guess_indent(text)
    if before_dash is None:  # no list in lines
        writer.indent(mapping=indent or 2)
    else:
        writer.indent(mapping=2, sequence=indent, offset=before_dash)
    for path, value in values.items():
        node = root
        for depth, key in enumerate(path[:-1], 1):
            node = node.get(key)
            if not isinstance(node, CommentedMap):
                found = "missing" if node is None else "no mapping"
                raise InputError(where, ".".join(path[:depth]), found, "a mapping of keys")
        node[path[-1]] = _laid_out(writer, value)
    out = io.StringIO()
    writer.dump(root, out)
    made = parse_yaml(out.getvalue(), f"{where}, edited")
    for path, value in values.items():
        if reduce(operator.getitem, path, made) != value:
            raise InputError(where, ".".join(path), "cannot be edited", "a plain value")
    return out.getvalue()


def _laid_out(writer: YAML, value: Any, *, inner: bool = False) -> Any:
    """Return a value with its layout: a mapping as lines, each of its entries on one line."""
    if isinstance(value, Mapping):
        made = CommentedMap((k, _laid_out(writer, v, inner=True)) for k, v in value.items())
        if inner:
            made.fa.set_flow_style()
        return made
    if isinstance(value, list):
        row = writer.seq(value)
        row.fa.set_flow_style()
        return row
    return value
