"""Files that people write: YAML checked against a declared shape, the first fault in one line."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import read_yaml

__all__ = ["RANGES", "Closed", "Declared", "Misdeclared", "parse_declared", "range_of", "read_yaml"]

T = TypeVar("T", bound=BaseModel)


class Misdeclared(ValueError):  # noqa: N818  (pydantic turns a ValueError into its own error)
    """A fault of several keys together, reported at the key to correct."""

    def __init__(self, field: str, value: object, allowed: object) -> None:
        super().__init__(f"{field}: {value}; allowed: {allowed}")
        self.field, self.value, self.allowed = field, value, str(allowed)


RANGES: Mapping[str, tuple[float, float]] = {
    "_m": (-1e6, 1e6),
    "_deg": (-36e3, 36e3),
    "_kg": (0.0, 1e6),
    "_pa": (1e6, 1e14),
    "_nm2": (1e-9, 1e18),
    "_mps2": (-50.0, 50.0),
    "_c": (-273.15, 2000.0),
    "t_s": (-1e10, 1e10),
}
"""Allowed range of a quantity, by the end of its key, which gives the unit. No machine is beyond:
such a value has a wrong unit, as gravity in mm/s^2."""


class Closed(BaseModel):
    """A frozen record that refuses non-finite numbers, and unknown keys (it lists the known)."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        fields = cls.model_fields.items()
        known = {field.alias or name for name, field in fields if not field.exclude}
        for key, given in data.items() if isinstance(data, dict) else ():
            if key not in known:
                raise Misdeclared(str(key), given, f"known keys: {', '.join(sorted(known))}")
        return data


class Declared(Closed):
    """A `Closed` record that also refuses a boolean for a number, and numbers beyond `RANGES`."""

    @model_validator(mode="before")
    @classmethod
    def _no_booleans(cls, data: Any) -> Any:
        for key, given in data.items() if isinstance(data, dict) else ():
            field = cls.model_fields.get(key)
            if field is None or "bool" in str(field.annotation):
                continue
            for path, value in _leaves(key, given):
                if isinstance(value, bool):
                    raise Misdeclared(path, value, "a number, or text in quotes")
        return data

    @model_validator(mode="after")
    def _in_range(self) -> Any:
        for key in type(self).model_fields:
            lower, upper = range_of(key)
            for path, value in _leaves(key, getattr(self, key)):
                if isinstance(value, (int, float)) and not lower <= value <= upper:
                    raise Misdeclared(path, value, f"{lower:g} to {upper:g}")
        self.check_together()
        return self

    def check_together(self) -> None:
        """Raise `Misdeclared` if values that are in their ranges do not fit together."""


def range_of(key: str) -> tuple[float, float]:
    """Return the allowed range of a quantity, by the unit at the end of its key; else infinite."""
    return next((r for end, r in RANGES.items() if key.endswith(end)), (-math.inf, math.inf))


def _leaves(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield path and value of every entry of a field's lists; records are not entered.

    The records check their own values.
    """
    if isinstance(value, (list, tuple)):
        for k, part in enumerate(value):
            yield from _leaves(f"{path}.{k}", part)
    else:
        yield path, value


def parse_declared(cls: type[T], data: Any, where: str) -> T:
    """Validate parsed YAML against a declared model; the first fault becomes an `InputError`."""
    if not isinstance(data, dict):
        raise InputError(where, "document", type(data).__name__, "a mapping of keys")
    try:
        return cls.model_validate(data)
    except ValidationError as error:
        raise InputError(where, *_fault(data, error)) from error


def _fault(data: Any, error: ValidationError) -> tuple[str, Any, str]:
    """Return (field, value, allowed) of the first fault.

    If a value may have one of several shapes, it is the fault of the shape that fits best.
    """
    faults = error.errors(include_url=False)
    paths = [_path(data, fault) for fault in faults]
    same = [k for k, path in enumerate(paths) if path[: len(paths[0])] == paths[0]]
    chosen = max(same, key=lambda k: len(paths[k]))
    fault, path = faults[chosen], paths[chosen]
    told = fault.get("ctx", {}).get("error")
    if isinstance(told, Misdeclared):
        return ".".join((*map(str, path), told.field)), told.value, told.allowed
    field = ".".join(map(str, path)) or "document"
    if fault["type"] == "missing":
        return field, "missing", "a value: it is required"
    texts = [faults[k]["msg"] for k in same if paths[k] == path]
    allowed = " or ".join(dict.fromkeys(t.removeprefix("Value error, ") for t in texts))
    return field, fault.get("input"), allowed


def _path(data: Any, fault: Mapping[str, Any]) -> tuple[int | str, ...]:
    """Return the keys of a fault's place that are in the file, without names of allowed shapes."""
    kept: list[int | str] = []
    node = data
    for part in fault["loc"]:
        try:
            node = node[part]
        except (KeyError, IndexError, TypeError):
            continue
        kept.append(part)
    return (*kept, fault["loc"][-1]) if fault["type"] == "missing" else tuple(kept)
