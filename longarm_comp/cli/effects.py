"""``longarm effects``."""

from __future__ import annotations

import math

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, say


@click.command()
@options.effects
@options.as_json
def command() -> None:
    """Print the library of effects: parameters, units, priors, bounds, needed inputs.

    \b
    Example:
      longarm effects
      longarm effects --json
      longarm effects --effects my_effects.py
    """
    rows = catalogue()
    print_json(rows)
    say(_markdown(rows))


def catalogue() -> list[dict[str, object]]:
    """One row per effect, from its declaration. Effects of other packages show their source."""
    from longarm_comp.core.effects.catalogue import origin, registered
    from longarm_comp.core.effects.effect import Bias

    return [
        {
            "effect": name,
            "side": "camera" if issubclass(kind, Bias) else "arm",
            "geometry": kind.geometry,
            "from": origin(kind) or "longarm_comp",
            "meaning": " ".join((kind.__doc__ or "").split("\n\n")[0].split()),
            "needs": list(kind.needs),
            "parameters": [
                {
                    "name": p.name,
                    "unit": p.unit,
                    "prior": p.prior,
                    "unknown": p.unknown,
                    "lower": p.lower if math.isfinite(p.lower) else None,
                    "upper": p.upper if math.isfinite(p.upper) else None,
                }
                for p in kind.declared()
            ],
        }
        for name, kind in registered().items()
    ]


def _markdown(rows: list[dict[str, object]]) -> str:
    """A table in Markdown."""
    lines = ["| effect | what | parameters (unit, prior, bounds) | needs |", "|---|---|---|---|"]
    for row in rows:
        parameters: list[dict[str, object]] = row["parameters"]  # type: ignore[assignment]
        needs: list[str] = row["needs"]  # type: ignore[assignment]
        listed = "; ".join(map(_parameter, parameters)) or "none"
        source = "" if row["from"] == "longarm_comp" else f" ({row['from']})"
        cells = (f"`{row['effect']}`", f"{row['meaning']}{source}", listed, ", ".join(needs))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _parameter(p: dict[str, object]) -> str:
    bounds = [
        f"{sign} {p[end]:g}"
        for end, sign in (("lower", ">="), ("upper", "<="))
        if p[end] is not None
    ]
    facts = [str(p["unit"]), "unknown" if p["unknown"] else f"{p['prior']:g}", *bounds]
    return f"{p['name']} ({', '.join(facts)})"
