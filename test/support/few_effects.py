"""A short catalogue, for diagnoses whose choice among all effects is not the question."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest

from longarm_comp.core.calibration import candidates
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.plays import Backlash

FEW = (JointGain, GearEccentricity, JointCompliance, Backlash)
"""A name with one that imitates it at few levels, and one of either other kind."""


@contextlib.contextmanager
def few_effects() -> Iterator[None]:
    """Diagnoses of this process try these four names, and functions without one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(candidates, "searched_effects", lambda: FEW)
        yield
