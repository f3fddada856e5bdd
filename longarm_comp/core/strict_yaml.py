"""The only reader of YAML: it refuses files that are ambiguous, or too large when expanded.

YAML 1.1 reads ``015`` as octal 13 and ``1:30`` as base 60, and lets the last of two equal keys win.
Here each of these is an error that gives the field. Files are bounded in bytes, nesting and values,
counted after aliases are followed. libyaml finds the values where it is installed; what it refuses,
PyYAML reads once more, which shows the place.
"""

import math
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import check_regular

try:
    from yaml._yaml import CParser
except ImportError:  # PyYAML was built without libyaml
    CParser = None  # type: ignore[assignment, misc]

MOST_BYTES = 8_000_000
MOST_VALUES = 200_000
DEEPEST = 40
_INT, _FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
# Up to 19 digits: rosbag2 writes the largest 64-bit integer for an empty file.
_DECIMAL = re.compile(r"[-+]?(0|[1-9]\d{0,18})")
_REAL = re.compile(
    r"[-+]?((0|[1-9]\d*)\.\d*|\.\d+|\d+(?=[eE]))([eE][-+]?\d{1,3})?|[-+]?\.(inf|Inf|INF)|\.nan"
)
_OCTAL_LIKE = re.compile(r"[-+]?0\d+")
# libyaml takes these for white space, part of a word or a comment, PyYAML does not.
_READ_OTHERWISE = re.compile("[\t?\ufeff]|[>|][-+0-9]*#|%YAML")


class _Refused(Exception):  # noqa: N818  (becomes an InputError that knows the file)
    """Field, value and what is allowed."""


# Of the constructors: a date 2024-99-99, a tag such as !!bool or !!timestamp on another word.
_REFUSALS = (_Refused, yaml.YAMLError, RecursionError, ValueError, TypeError, LookupError,
             AttributeError)  # fmt: skip


class _Loader(yaml.SafeLoader):
    """Safe loader that counts nesting and values while it composes."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = self._values = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Compose one node within the bounds."""
        event: Any = self.peek_event()
        line = f"line {event.start_mark.line + 1}"
        self._depth += 1
        if self._depth > DEEPEST:
            raise _Refused(line, f"nested more than {DEEPEST} deep", f"at most {DEEPEST} levels")
        before = self._values
        node: yaml.Node | None = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            if id(node) not in self._sizes:
                raise _Refused(line, f"*{event.anchor}", "an alias of a value that is complete")
            self._values += self._sizes[id(node)]
        else:
            self._values += 1
            self._sizes[id(node)] = self._values - before
        if self._values > MOST_VALUES:
            raise _Refused(line, f"more than {MOST_VALUES} values", "fewer, aliases followed")
        self._depth -= 1
        return node


class _FastLoader(_Loader):
    """The same, of what libyaml finds in the text."""

    def __init__(self, text: str) -> None:
        super().__init__("")
        parser = CParser(text)
        for name in ("check_event", "peek_event", "get_event"):
            setattr(self, name, getattr(parser, name))


# Whole-number exponents are numbers in YAML 1.2 and in every other format: 1e-3, 2E5.
_Loader.add_implicit_resolver(
    _FLOAT, re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d{1,3}$"), list("-+0123456789")
)


def read_yaml(path: str | Path) -> Any:
    """Return the data of a YAML file; None if it is empty. Raises InputError."""
    return parse_yaml(read_text(path), str(path))


def read_text(path: str | Path) -> str:
    """Return the text of a file; InputError unless it is regular UTF-8 of up to `MOST_BYTES`."""
    where = str(path)
    check_regular(path)
    try:
        with open(path, "rb") as file:
            raw = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        said = getattr(error, "strerror", None) or str(error)
        raise InputError(where, "file", said, "a readable file") from error
    if len(raw) > MOST_BYTES:
        raise InputError(where, "file", f"more than {MOST_BYTES} bytes", "a smaller file")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        said = f"byte {error.start} is no text"
        raise InputError(where, "file", said, "text in UTF-8") from error


def parse_yaml(text: str, where: str) -> Any:
    """Return the data of a YAML text; None if it is empty.

    Args:
        where: its source, for error messages.

    Raises:
        InputError: the text is no valid YAML, is ambiguous, or exceeds the bounds of this module.
    """
    if CParser is not None and _READ_OTHERWISE.search(text) is None:
        with suppress(*_REFUSALS):
            return _construct(_FastLoader(text))
    try:
        return _construct(_Loader(text))
    except _Refused as refused:
        raise InputError(where, *refused.args) from None
    except yaml.YAMLError as error:
        raise InputError(where, "YAML", " ".join(str(error).split()), "valid YAML") from error
    except _REFUSALS as error:
        raise InputError(where, "YAML", str(error), "plain values") from error


def _construct(loader: _Loader) -> Any:
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _check(node)
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _check(root: yaml.Node) -> None:
    """Refuse numbers that are not plain decimal, and duplicate keys."""
    seen: set[int] = set()
    ahead: list[tuple[yaml.Node, str]] = [(root, "")]
    while ahead:
        node, path = ahead.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.ScalarNode):
            _check_number(node, path or "document")
        ahead += reversed(list(_list_children(node, path)))


def _list_children(node: yaml.Node, path: str) -> Iterator[tuple[yaml.Node, str]]:
    if isinstance(node, yaml.SequenceNode):
        for k, value in enumerate(node.value):
            yield value, f"{path}.{k}".lstrip(".")
    elif isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            name = str(key.value) if isinstance(key, yaml.ScalarNode) else "?"
            field, line = f"{path}.{name}".lstrip("."), key.start_mark.line + 1
            if isinstance(key, yaml.ScalarNode) and name in lines:
                raise _Refused(field, f"twice, lines {lines[name]} and {line}", "each key once")
            lines[name] = line
            yield key, field
            yield value, field


def _check_number(node: yaml.ScalarNode, field: str) -> None:
    text = node.value
    if node.style:  # in quotes, or a block
        return
    if node.tag in (_INT, _FLOAT):
        plain = (_DECIMAL if node.tag == _INT else _REAL).fullmatch(text) is not None
    else:
        plain = _OCTAL_LIKE.fullmatch(text) is None
    if not plain:
        allowed = "a decimal number such as 15 or -1.5; text in quotes"
        raise _Refused(f"{field} (line {node.start_mark.line + 1})", text, allowed)
    if node.tag == _FLOAT and text[-1].isdigit() and not math.isfinite(float(text)):
        raise _Refused(field, text, "a finite number")
