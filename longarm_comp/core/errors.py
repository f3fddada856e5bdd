"""The one error tree. Every error says, on one line, what a user needs in order to act."""

from functools import partial
from typing import Any, ClassVar

_LONGEST_VALUE = 240  # three likely mistakes in the rows of a session take 200


class LongarmError(Exception):
    """Base class of the errors that this package reports to its user."""

    exit_code: ClassVar[int] = 1


class InputError(LongarmError):
    """An input is wrong: a file, a message or an argument.

    Args:
        where: the file, topic, service or function that the value came from.
        field: the column, key or argument; a row may be part of it (``"row 12, q3"``).
        value: what was found there.
        allowed: what is allowed there, in words.
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, where: object, field: object, value: object, allowed: object) -> None:
        super().__init__(where, field, value, allowed)
        self.where = _one_line(where)
        self.field = _one_line(field)
        self.value = value
        self.allowed = _one_line(allowed)

    def __str__(self) -> str:
        return f"{self.where}: {self.field}: {_on_one_line(self.value)}; allowed: {self.allowed}"


class JobError(LongarmError):
    """The input is good, but the job could not be done: a target out of reach, no convergence.

    Args:
        reason: why, in one sentence.
        facts: values that help to act on it, as ``name=value`` (``residual_m=0.02``).
    """

    exit_code: ClassVar[int] = 3

    def __init__(self, reason: str, **facts: object) -> None:
        super().__init__(reason)
        self.reason = _one_line(reason)
        self.facts: dict[str, Any] = facts

    def __reduce__(self) -> tuple[object, ...]:
        return partial(type(self), **self.facts), (self.reason,)  # pickle forgets keywords

    def __str__(self) -> str:
        if not self.facts:
            return self.reason
        facts = ", ".join(f"{name}={_on_one_line(value)}" for name, value in self.facts.items())
        return f"{self.reason} ({facts})"


def _one_line(text: object) -> str:
    return " ".join(str(text).split())


def _on_one_line(value: object) -> str:
    """Return a value as one line of bounded length; numbers without their wrapper type's name."""
    text = repr(value) if isinstance(value, str) else _one_line(value)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."
