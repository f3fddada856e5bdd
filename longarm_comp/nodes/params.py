"""Parameters of a node: declared with description and range; unknown names are refused."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from longarm_comp.core.errors import InputError

ROS_OWN = ("use_sim_time", "start_type_description_service", "qos_overrides")


@dataclass(frozen=True)
class Param:
    """One parameter of a node.

    Attributes:
        default: default value; its type is the type of the parameter.
        lower, upper: allowed range of a number, or of each number of a list.
        choices: allowed texts.
        live: whether it may be set while the node runs; all others are read-only.
    """

    name: str
    default: bool | int | float | str | list[float]
    description: str
    lower: float = -1e9
    upper: float = 1e9
    choices: tuple[str, ...] = ()
    live: bool = False

    def descriptor(self) -> ParameterDescriptor:
        limits: dict[str, Any] = {}
        if self.is_bounded and isinstance(self.default, float):
            real = FloatingPointRange(from_value=float(self.lower), to_value=float(self.upper))
            limits["floating_point_range"] = [real]
        elif self.is_bounded and isinstance(self.default, int):
            whole = IntegerRange(from_value=int(self.lower), to_value=int(self.upper), step=1)
            limits["integer_range"] = [whole]
        elif self.is_bounded:
            limits["additional_constraints"] = self.allowed_values
        return ParameterDescriptor(
            name=self.name, description=self.description, read_only=not self.live, **limits
        )

    @property
    def is_bounded(self) -> bool:
        """True if only some values of the type are allowed."""
        return bool(self.choices) or self.lower > -1e9 or self.upper < 1e9

    @property
    def allowed_values(self) -> str:
        kind = "numbers" if isinstance(self.default, list) else type(self.default).__name__
        if self.choices:
            return "one of " + ", ".join(self.choices)
        return f"{kind}, {self.lower:g} to {self.upper:g}" if self.is_bounded else kind

    @property
    def comment(self) -> str:
        """The comment on this parameter in the parameter file."""
        live = "; may be set while running" if self.live else ""
        return self.description + (f" ({self.allowed_values})" if self.is_bounded else "") + live

    def check(self, value: Any) -> Any:
        """Return a value in the parameter's type; ValueError or TypeError if it is not allowed."""
        if isinstance(self.default, float) and type(value) is int:
            value = float(value)
        if isinstance(self.default, list):
            value = [float(v) for v in value]
            if len(self.default) > 1 and len(value) != len(self.default):
                raise ValueError
        elif type(value) is not type(self.default):
            raise ValueError
        if not isinstance(value, (str, bool)):
            numbers = value if isinstance(value, list) else [value]
            if not all(self.lower <= number <= self.upper for number in numbers):
                raise ValueError
        if self.choices and value not in self.choices:
            raise ValueError
        return value


def declare(node: Node, table: Sequence[Param], sections: Sequence[str] = ()) -> dict[str, Any]:
    """Declare and check all parameters of a node; return their values by name.

    ``sections``: prefixes of given parameters that are checked elsewhere.

    Raises:
        InputError: a given parameter is unknown, or its value is not allowed.
    """
    known = {param.name: param for param in table}
    given = {k: v for k, v in given_parameters(node).items() if k.split(".")[0] not in sections}
    for name in given.keys() - known.keys():
        raise InputError(where(node), name, given[name], "known: " + ", ".join(known))
    values = {}
    for name, param in known.items():
        value = given.get(name, param.default)
        try:
            value = param.check(value)
            _declare_again(node, name, value, param.descriptor())
        except (TypeError, ValueError, ParameterException):
            raise InputError(where(node), name, value, param.allowed_values) from None
        values[name] = value

    def check_set(asked: Sequence[Parameter]) -> SetParametersResult:
        """Refuse values that a parameter does not allow, while the node runs."""
        for given in asked:
            param = known.get(given.name)
            if param is None:  # of ROS, or of a section that is checked elsewhere
                continue
            try:
                param.check(given.value)
            except (TypeError, ValueError):
                why = f"{given.name}: {given.value!r}; allowed: {param.allowed_values}"
                return SetParametersResult(successful=False, reason=why)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check_set)
    return values


def _declare_again(node: Node, name: str, value: Any, descriptor: ParameterDescriptor) -> None:
    """Declare a parameter with a description, even if ROS declared it from an override before."""
    if node.has_parameter(name):
        node.undeclare_parameter(name)
    node.declare_parameter(name, value, descriptor, ignore_override=True)


def declare_sections(node: Node, sections: Mapping[str, type[BaseModel]]) -> dict[str, Any]:
    """Declare the given parameters whose first prefix is a section, with description and range.

    Return the values as nested dictionaries, not yet checked by the section's model.
    """
    tree: dict[str, Any] = {}
    for name, value in given_parameters(node).items():
        *path, field = name.split(".")
        section = name.split(".")[0]
        if section not in sections:
            continue
        # An unknown field is refused by the section's own check
        schema = sections[section].model_json_schema()["properties"].get(field, {})
        if "enum" in schema:
            limits = ["one of " + ", ".join(map(str, schema["enum"]))]
        else:
            kinds = (schema, *schema.get("anyOf", ()))
            limits = [
                f"{word} {k[limit]:g}" for k in kinds for limit, word in _LIMITS if limit in k
            ]
        described = ParameterDescriptor(
            read_only=True,
            description=schema.get("description", ""),
            additional_constraints=" ".join(limits),
        )
        _declare_again(node, name, value, described)
        place = tree
        for part in path:
            place = place.setdefault(part, {})
        place[field] = value
    return tree


_LIMITS = (
    ("minimum", "from"),
    ("exclusiveMinimum", "above"),
    ("maximum", "to"),
    ("exclusiveMaximum", "below"),
)
"""Keywords of JSON Schema for limits of a number, and words for them."""


def given_parameters(node: Node) -> dict[str, Any]:
    """Return the given parameters by name: of the command line and its files, without ROS's own."""
    names = node.list_parameters([], 0).names
    own = [name for name in names if name.split(".")[0] not in ROS_OWN]
    return {name: node.get_parameter(name).value for name in own}


def where(node: Node) -> str:
    return f"parameters of {node.get_fully_qualified_name()}"
