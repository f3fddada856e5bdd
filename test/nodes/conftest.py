"""The stops of a driver without the rest of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from nodes_bench import Bench
    from stops_bench import StoppedArm


@pytest.fixture
def driver(stage: Bench, tmp_path: Path) -> Iterator[StoppedArm]:
    """A configured arm with its stops, which nobody has asked for; every servo hears at the end."""
    from stops_bench import stopped_arm

    with stopped_arm(stage, tmp_path / "stops") as made:
        made.configure()
        yield made
        made.emulator.loses = None
