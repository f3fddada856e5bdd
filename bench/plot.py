"""Bar chart of the ratios of one run; above 1 is better than the peer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

Row = Mapping[str, Any]

_AHEAD, _BEHIND = "#2a7f62", "#b5542b"


def draw(rows: Sequence[Row], title: str, path: Path) -> None:
    """Write a PNG of the rows that have a ratio; the others are in the JSON only.

    Args:
        rows: as `longarm bench` prints them, in order; the first is on top.
        title: machine and load.
        path: of the picture.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    shown = [row for row in rows if row.get("ratio") and row.get("spread")][::-1]
    figure, axes = plt.subplots(figsize=(12, 1.6 + 0.36 * max(len(shown), 1)), layout="constrained")
    for place, row in enumerate(shown):
        ratio, (low, high) = float(row["ratio"]), row["spread"]
        colour = _AHEAD if ratio >= 1.0 else _BEHIND
        axes.barh(place, ratio - 1.0, left=1.0, height=0.62, color=colour, alpha=0.85)
        axes.plot([low, high], [place, place], color="black", linewidth=1.2, marker="|")
        side = axes.get_yaxis_transform()
        axes.text(
            1.01, place, f"{ratio:.3g}", transform=side, va="center", weight="bold", fontsize=8
        )
        peer, theirs = str(row["peer"]), row.get("peer_value")
        peer = peer if len(peer) <= 44 else peer[:42] + ".."
        text = f"{_number(row['value'])} {row['unit']}; {peer}"
        text += "" if theirs is None else f": {_number(theirs)}"
        axes.text(1.095, place, text, transform=side, va="center", fontsize=8)
    axes.set_yticks(range(len(shown)), [str(row["name"]) for row in shown], fontsize=8)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_xlabel("times ahead of the peer or floor (black: spread of the repeats)", fontsize=9)
    axes.grid(axis="x", which="both", alpha=0.25)
    axes.set_title(title, fontsize=9, loc="left")
    axes.set_ylim(-0.7, len(shown) - 0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
