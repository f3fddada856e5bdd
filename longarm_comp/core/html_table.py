"""A sentence and a table as a notebook shows them."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any


def html_table(said: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the HTML of a sentence above a table; its rows have equal keys, floats four digits."""
    head = "".join(f"<th>{escape(str(key))}</th>" for key in rows[0]) if rows else ""
    body = ""
    for row in rows:
        cells = (f"{v:.4g}" if isinstance(v, float) else str(v) for v in map(row.get, rows[0]))
        body += "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"
    return f"<p>{escape(said)}</p><table><tr>{head}</tr>{body}</table>"
