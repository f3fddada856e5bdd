"""A limitation of a session that is admitted."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AdmissionFinding:
    """A limitation of a session that is admitted."""

    check: str
    field: str
    message: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.field}: {self.message}"
