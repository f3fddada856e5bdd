"""A sentence and a table as a notebook shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any


def html_table(said: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """HTML of a sentence above rows of the same keys; numbers with four digits."""
    head = "".join(f"<th>{escape(str(key))}</th>" for key in rows[0]) if rows else ""
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(_cell_text(row[key]))}</td>" for key in rows[0]) + "</tr>"
        for row in rows
    )
    return f"<p>{escape(said)}</p><table><tr>{head}</tr>{body}</table>"


def _cell_text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
