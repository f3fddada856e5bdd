"""The templates of the pages, and what is laid into them."""

from __future__ import annotations

import base64
from functools import cache
from importlib.resources import files

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


def beside(name: str) -> str:
    """Text of a style or script that lies beside the templates."""
    return files("longarm_comp.report").joinpath(f"templates/{name}").read_text("utf-8")


def data_uri(svg: bytes) -> str:
    """A picture as an address that holds it."""
    return f"data:image/svg+xml;base64,{base64.b64encode(svg).decode('ascii')}"
