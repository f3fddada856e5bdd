"""What may move the rows besides an explanation, and is no finding."""

from __future__ import annotations

from typing import NamedTuple


class Slack(NamedTuple):
    """What may move the rows besides an explanation, and is no finding.

    Attributes:
        form: share of its own shift by which the form of an effect in the model may err.
        give: whether every part gives way a little, as in real arms (`give.py`).
    """

    form: float
    give: bool


FORMS = (0.01, 0.03, 0.1)
"""Shares of its own shift by which an effect's form may err, equally likely beforehand: play,
friction and stiffness of real joints differ by a tenth from place to place along their way."""
TOLERANCES = tuple(Slack(form, give) for form in FORMS for give in (True, False))
"""Each as likely as the others."""
BARE = TOLERANCES[:2]
"""Where nothing is in the model."""
