"""A short catalogue, for diagnoses whose choice among all effects is not the question."""

import contextlib
import functools
from collections.abc import Iterator, Sequence

import pytest

from longarm_comp.core.calibration import candidates
from longarm_comp.core.effects import catalogue
from longarm_comp.core.effects.camera_errors import CameraDrift
from longarm_comp.core.effects.catalogue import Kind
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.identify import diagnose as steps
from longarm_comp.core.identify.posterior.explain import explain_session

FEW = (JointGain, GearEccentricity, JointCompliance, Backlash, CameraDrift)
"""A name, what imitates it at few levels, two of other kinds, and one that needs times."""


@contextlib.contextmanager
def few_effects(kinds: Sequence[Kind] = FEW) -> Iterator[None]:
    """Diagnoses of this process try these effects, registered ones, and functions."""
    with pytest.MonkeyPatch.context() as patch:
        others = catalogue._others
        patch.setattr(
            candidates, "searched_effects", lambda: (*kinds, *(kind for kind, _ in others.values()))
        )
        yield


@contextlib.contextmanager
def names_alone() -> Iterator[None]:
    """Diagnoses of this process offer no function: which of the names it is, is the question."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, "explain_session", functools.partial(explain_session, functions=False))
        yield
