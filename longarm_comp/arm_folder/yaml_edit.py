"""Values replaced in the text of a YAML file; comments and order stay as they are."""

from __future__ import annotations

import io
import operator
from collections.abc import Mapping
from functools import reduce
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.util import load_yaml_guess_indent

from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import parse_yaml

Path = tuple[str, ...]


def edited(text: str, values: Mapping[Path, Any], where: object) -> str:
    """The text with other values.

    Args:
        values: by the keys that lead to them. A key that is not there is added behind its
            neighbours. A mapping becomes a block of lines, a list stands on one line.
    """
    parse_yaml(text, str(where))
    writer = YAML()
    writer.preserve_quotes, writer.width = True, 10**6
    root = writer.load(text)
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


def ros_path(text: str) -> Path:
    """Keys that lead to ``ros__parameters``; none for a plain file."""
    root = parse_yaml(text, "parameters")
    for key, node in root.items() if isinstance(root, dict) else ():
        if isinstance(node, dict) and "ros__parameters" in node:
            return (str(key), "ros__parameters")
    return ()


def _laid_out(writer: YAML, value: Any, *, inner: bool = False) -> Any:
    """A value as it is written: a mapping in lines, what is in it on one line each."""
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
