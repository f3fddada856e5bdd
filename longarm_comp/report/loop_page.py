"""The one page of a loop: error at the tip before and after every round, what was found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from longarm_comp.report.at_the_tip import at_the_tip
from longarm_comp.report.style import rc, svg
from longarm_comp.report.template import beside, data_uri, template


def loop_page(data: Mapping[str, Any], errors: Mapping[str, np.ndarray]) -> str:
    """The page as text, self-contained.

    Args:
        data: what `jobs.loop.summary` makes.
        errors: by name of the run, (N, 3) tip - target, m.
    """
    with rc():
        picture = data_uri(svg(at_the_tip(errors)))
    return template("loop.html.j2").render(loop=data, picture=picture, style=beside("report.css"))
