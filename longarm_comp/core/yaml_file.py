"""Files that people write: YAML checked against a declared shape, the first fault in one line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from longarm_comp.core.errors import InputError

T = TypeVar("T", bound=BaseModel)


class Declared(BaseModel):
    """Frozen; unknown keys and non-finite numbers are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Misdeclared(ValueError):  # noqa: N818  (pydantic turns a ValueError into its own error)
    """A fault of several keys together, reported at the key to correct.

    Args:
        field: path of the key below the validated mapping.
        value: what stands there.
        allowed: what may, in words.
    """

    def __init__(self, field: str, value: object, allowed: object) -> None:
        super().__init__(f"{field}: {value}; allowed: {allowed}")
        self.field, self.value, self.allowed = field, value, str(allowed)


def read_yaml(path: str | Path) -> Any:
    """Parsed YAML of a file; `InputError` where it cannot be read."""
    try:
        return yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(str(path), "file", type(error).__name__, "a readable file") from error
    except yaml.YAMLError as error:
        raise InputError(str(path), "YAML", " ".join(str(error).split()), "valid YAML") from error


def parse_declared(cls: type[T], data: Any, where: str) -> T:
    """Validate parsed YAML against a declared model; the first fault becomes an `InputError`."""
    if not isinstance(data, dict):
        raise InputError(where, "document", type(data).__name__, "a mapping of keys")
    try:
        return cls.model_validate(data)
    except ValidationError as error:
        raise InputError(where, *_fault(cls, data, error)) from error


def _fault(cls: type[BaseModel], data: Any, error: ValidationError) -> tuple[str, Any, str]:
    """(field, value, allowed) of the first fault; of a choice of shapes, the nearest one."""
    faults = error.errors(include_url=False)
    paths = [_path(data, fault) for fault in faults]
    same = [k for k, path in enumerate(paths) if path[: len(paths[0])] == paths[0]]
    chosen = max(same, key=lambda k: len(paths[k]))
    fault, path = faults[chosen], paths[chosen]
    told = fault.get("ctx", {}).get("error")
    if isinstance(told, Misdeclared):
        return ".".join((*map(str, path), told.field)), told.value, told.allowed
    if fault["type"] == "extra_forbidden":
        allowed = "known keys: " + ", ".join(_known_keys(cls, fault["loc"][:-1]))
    else:
        texts = [faults[k]["msg"] for k in same if paths[k] == path]
        allowed = " or ".join(dict.fromkeys(t.removeprefix("Value error, ") for t in texts))
    value = "missing" if fault["type"] == "missing" else fault.get("input")
    return ".".join(map(str, path)) or "document", value, allowed


def _path(data: Any, fault: Mapping[str, Any]) -> tuple[int | str, ...]:
    """The keys of a fault's place that stand in the file (not the names of a choice of shapes)."""
    kept: list[int | str] = []
    node = data
    for part in fault["loc"]:
        try:
            node = node[part]
        except (KeyError, IndexError, TypeError):
            continue
        kept.append(part)
    return (*kept, fault["loc"][-1]) if fault["type"] == "missing" else tuple(kept)


def _known_keys(cls: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Keys that the schema knows at `path`."""
    schema = cls.model_json_schema()
    node: Any = schema
    for part in (*path, None):
        while "$ref" in node or "anyOf" in node or "oneOf" in node:
            if "$ref" in node:
                node = schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
                continue
            options = node.get("anyOf") or node["oneOf"]
            tagged = node.get("discriminator", {}).get("mapping", {})
            if part in tagged:
                node = {"$ref": tagged[part]}
                part = None
                break
            named = [o for o in options if o.get("$ref", "").endswith(f"/{part}")]
            if named or str(part).startswith("list["):
                node, part = (named or [o for o in options if "items" in o])[0], None
                break
            node = next(
                (o for o in options if "$ref" in o or "oneOf" in o or "items" in o), options[0]
            )
        if part is None:
            if "$ref" in node:
                node = schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
            continue
        if isinstance(part, int):
            node = node.get("items", {})
        else:
            node = node.get("properties", {}).get(part, node.get("additionalProperties", {}))
        if not isinstance(node, dict):
            return []
    return sorted(node.get("properties", {}))
