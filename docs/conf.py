"""The documentation as pages: `make docs`. The pages of effects are made with it."""

import os
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE / "made_by")]

from longarm_comp.version import __version__  # noqa: E402  (of this checkout

project = "longarm_comp"
author = "longarm_comp developers"
release = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["made_by/*"]
html_theme = "furo"
html_title = f"longarm_comp {release}"
html_show_sourcelink = False
html_copy_source = False
html_show_copyright = False
myst_heading_anchors = 3
napoleon_use_ivar = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
nb_execution_mode = os.environ.get("LONGARM_NOTEBOOKS", "force")
nb_execution_timeout = 600
nb_execution_raise_on_error = True
suppress_warnings = [] if nb_execution_mode == "force" else ["myst-nb.lexer"]

PAGE = re.compile(r"`docs/(\w+)\.md`")
"""How pages name each other, so that they read the same in a checkout."""


def linked(app: Any, name: str, source: list[str]) -> None:
    """Pages that are named become links with their titles."""
    up = "../" * name.count("/")
    source[0] = PAGE.sub(rf"[]({up}\1.md)", source[0])


def make(app: Any) -> None:
    """Write the pages of the effects, below docs/made."""
    import effect_pages

    effect_pages.write(HERE / "made" / "effects")


def setup(app: Any) -> None:
    """Connect both."""
    app.connect("builder-inited", make)
    app.connect("source-read", linked)
