"""``longarm bench``: the command of the folder `bench`, which is not installed."""

from __future__ import annotations

from longarm_comp.cli import checkout

checkout.use("bench")
from bench.command import command  # noqa: E402, F401
