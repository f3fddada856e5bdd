"""Servos of both protocols, and a setup that nobody watches."""

import io
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from servo_bench import MODELS, two

from longarm_comp.sim.servo_emulator.emulator import ServoEmulator


@pytest.fixture
def nobody_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nobody answers at a terminal; what a setup keeps is kept for this test alone."""
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture(params=MODELS)
def emulator(request: pytest.FixtureRequest) -> Iterator[ServoEmulator]:
    """Two directly driven servos."""
    with two(request.param) as made:
        yield made
