"""``longarm study``: the commands of the folder `studies`, which is not installed."""

from __future__ import annotations

from longarm_comp.cli import checkout
from longarm_comp.cli.run import LazyGroup

checkout.use("studies")
from studies.commands import STUDIES  # noqa: E402

command = LazyGroup(
    STUDIES,
    "study",
    "Studies that print the figures of docs/studies.md, from a checkout of the project.",
    folder="studies.commands",
)
