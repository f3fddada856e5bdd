"""Declarations of the fields of an effect: a fitted parameter, a place on the arm, or a form."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from longarm_comp.core.arm.arm import Arm

ALIKE = 0.95
"""Prior correlation of parameters that are like each other: they differ by a third of their size.

Of seven seats of first joints of real arms, five have two compliances within a factor of 1.6.
"""


@dataclass(frozen=True)
class Parameter:
    """One number of an effect: unit, meaning, prior standard deviation and physical bounds."""

    name: str
    unit: str  # SI
    meaning: str  # in a few words
    prior: float  # standard deviation of plausible values; 0 means fixed at its value
    lower: float = -math.inf  # physical bound
    upper: float = math.inf
    unknown: bool = False  # nothing is known in advance: the fit's prior has no influence
    like: str = ""
    """Name of a group of parameters of one effect that are probably nearly equal (`ALIKE`).

    It matters where explanations are compared; in a fit each is independent.
    """
    usual: float = 0.0
    """Standard deviation of the values that every arm has: no finding, and never fitted."""

    @property
    def width(self) -> float:
        """Standard deviation of the fit's prior: 50 m and 50 rad for a base of unknown place."""
        return 1000.0 * self.prior if self.unknown else self.prior


PARAMETER, PLACE, FORM, TRIED = "parameter", "place", "form", "tried"
Places = Callable[[Arm], Sequence[int] | Sequence[str]]


@cache
def metadata(kind: type[Any], role: str) -> dict[str, Any]:
    """Return what an effect's class declares of the fields of one role, by field name."""
    return {f.name: f.metadata[role] for f in dataclasses.fields(kind) if role in f.metadata}


def parameter(
    unit: str,
    meaning: str,
    prior: float,
    lower: float = -math.inf,
    upper: float = math.inf,
    default: float = 0.0,
    **further: Any,
) -> Any:
    """Declare a field as a fitted `Parameter`.

    Args:
        default: its value for an arm without this error.
        further: other attributes of `Parameter`.
    """
    made = Parameter("", unit, meaning, prior, lower, upper, **further)
    return dataclasses.field(default=default, metadata={PARAMETER: made})


def place(allowed: Places | None = None, default: int | str | None = None) -> Any:
    """Declare a field as a place. A model may hold several instances with different places.

    All places of one form together are a family, which a diagnosis tries as a whole.

    Args:
        allowed: a function that lists the allowed values on an arm (`moving_joints`, `beams`, ...
            or your own); None for any text.
        default: default value; None if the field is required.
    """
    given = {} if default is None else {"default": default}
    return dataclasses.field(**given, metadata={PLACE: allowed})  # type: ignore[call-overload]


def form(
    default: float | int | str,
    lower: float | None = None,
    upper: float | None = None,
    tried: Sequence[float] | Sequence[int] | Sequence[str] = (),
) -> Any:
    """Declare a field as a form: a variant of the effect, which is tried but not fitted.

    Args:
        lower, upper: ends of a continuous scale. With them, a diagnosis also tries values between
            those of the candidates.
        tried: the values of the candidates; by default only `default`.
    """
    if (lower is None) != (upper is None):
        raise TypeError("a form's scale has two ends")
    scale = None if lower is None else (lower, upper)
    return dataclasses.field(default=default, metadata={FORM: scale, TRIED: tuple(tried)})
