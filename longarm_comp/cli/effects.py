"""``longarm effects``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_table

if TYPE_CHECKING:
    from longarm_comp.core.effects.parameters import Parameter

_SHOWN = ("name", "unit", "prior", "unknown", "lower", "upper")


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
    from longarm_comp.core.effects.catalogue import origin, registered
    from longarm_comp.core.effects.effect import Bias

    facts, lines = [], []
    for name, kind in registered().items():
        meaning = " ".join((kind.__doc__ or "").split("\n\n")[0].split())
        source, parameters = origin(kind), kind.declared()
        facts.append(
            {
                "effect": name,
                "side": "camera" if issubclass(kind, Bias) else "arm",
                "geometry": kind.geometry,
                "from": source or "longarm_comp",
                "meaning": meaning,
                "needs": kind.needs,
                "parameters": [{key: getattr(p, key) for key in _SHOWN} for p in parameters],
            }
        )
        listed = "; ".join(map(_in_words, parameters))
        where = f" ({source})" if source else ""
        lines.append((name, meaning + where, listed or "none", ", ".join(kind.needs)))
    print_json(facts)
    header = ("effect", "what", "parameters (unit, prior, bounds)", "needs")
    print_table(f"{len(lines)} effects", header, lines)


def _in_words(p: Parameter) -> str:
    bounds = [f"{sign} {end:g}" for sign, end in ((">=", p.lower), ("<=", p.upper))]
    given = [text for text in bounds if "inf" not in text]
    return f"{p.name} ({', '.join([p.unit, 'unknown' if p.unknown else f'{p.prior:g}', *given])})"
