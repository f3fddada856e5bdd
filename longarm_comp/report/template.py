"""The templates of the pages."""

from __future__ import annotations

from functools import cache

import jinja2


@cache
def template(name: str) -> jinja2.Template:
    """A template of this package, compiled once."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("longarm_comp.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)
