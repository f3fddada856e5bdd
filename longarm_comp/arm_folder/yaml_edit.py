"""Values replaced in the text of a YAML file; comments, order and layout stay as they are."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from functools import reduce
from typing import Any

import yaml

from longarm_comp.arm_folder.parameter_file import one_line
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import parse_yaml

Path = tuple[str, ...]


def edited(text: str, values: Mapping[Path, Any], where: object) -> str:
    """The text with other values.

    Args:
        values: by the keys that lead to them. A key that is not there is added behind its
            neighbours.
    """
    for path, value in values.items():
        text = _with_value(text, path, one_line(value), where)
    made = parse_yaml(text, f"{where}, edited")
    for path, value in values.items():
        if reduce(operator.getitem, path, made) != value:
            raise InputError(where, ".".join(path), "cannot be edited", "a plain value")
    return text


def ros_path(text: str) -> Path:
    """Keys that lead to ``ros__parameters``; none for a plain file."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    for key, node in root.value if isinstance(root, yaml.MappingNode) else ():
        if isinstance(node, yaml.MappingNode) and any(
            k.value == "ros__parameters" for k, _ in node.value
        ):
            return (str(key.value), "ros__parameters")
    return ()


def _with_value(text: str, path: Path, written: str, where: object) -> str:
    node: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    for depth, key in enumerate(path):
        if not isinstance(node, yaml.MappingNode):
            raise InputError(where, ".".join(path[:depth]), "no mapping", "a mapping of keys")
        inner = next((value for name, value in node.value if name.value == key), None)
        if inner is None and depth < len(path) - 1:
            raise InputError(where, ".".join(path[: depth + 1]), "missing", "a mapping of keys")
        if inner is None:
            return _added(text, node, f"{key}: {written}")
        node = inner
    start, end = node.start_mark.index, _end(text, node)
    return text[:start] + (" " if start == end else "") + written + text[end:]


def _added(text: str, node: yaml.MappingNode, entry: str) -> str:
    """The entry behind the last one of a mapping."""
    last = _end(text, node.value[-1][1]) if node.value else node.start_mark.index + 1
    if node.flow_style:
        return text[:last] + (", " if node.value else "") + entry + text[last:]
    line = text.find("\n", last)
    line = len(text) if line < 0 else line
    indent = " " * node.value[0][0].start_mark.column
    return f"{text[:line]}\n{indent}{entry}{text[line:]}"


def _end(text: str, node: yaml.Node) -> int:
    """Where a node ends; a block's own mark stands where the next line begins."""
    end = int(node.end_mark.index)
    while end > node.start_mark.index and text[end - 1] in " \n":
        end -= 1
    return end
