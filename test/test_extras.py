"""Nothing is named beside what is hidden: what used to come with some effects stays away."""

from __future__ import annotations

import numpy as np
import pytest
from test_discover import DEMO, measured

from longarm_comp.core.effects.bearing_tilt import BearingTilt
from longarm_comp.core.effects.creep import Creep
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.gear_eccentricity import GearEccentricity
from longarm_comp.core.effects.joint_compliance import JointCompliance
from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.effects.link_stiffness import LinkStiffness
from longarm_comp.core.effects.telescope_clearance import TelescopeClearance
from longarm_comp.core.effects.thermal_growth import ThermalGrowth
from longarm_comp.core.effects.thermal_softening import ThermalSoftening
from longarm_comp.core.identify.calibrate import declared_model, geometry
from longarm_comp.core.identify.candidates import library
from longarm_comp.core.identify.evidence import key
from longarm_comp.core.identify.minor import settled
from longarm_comp.core.identify.remainder import without_remainders
from longarm_comp.core.identify.search import search
from longarm_comp.sim.hidden import drives, loads
from longarm_comp.sim.hidden import geometry as true_geometry
from longarm_comp.sim.hidden.base import HiddenEffect

ROWS, CLEARANCE, PADS = 120, 4e-4, 1e-5
TURNING = np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0])
ECCENTRIC = np.stack([8e-3 * TURNING, 3e-3 * TURNING]), np.full((2, 7), 0.7)
HIDDEN: dict[str, tuple[HiddenEffect, ...]] = {
    "telescope_clearance": (loads.TelescopeClearance(clearance=CLEARANCE, pads=PADS),),
    "gear_eccentricity": (drives.GearEccentricity(*ECCENTRIC),),
    "thermal_growth, thermal_softening": (
        true_geometry.ThermalGrowth(1.5e-4),
        loads.ThermalSoftening(1.3e-2),
    ),
}
KINDS: dict[str, tuple[type[Effect], ...]] = {
    "telescope_clearance": (TelescopeClearance, LinkStiffness, BearingTilt, JointCompliance),
    "gear_eccentricity": (GearEccentricity, JointGain),
    "thermal_growth, thermal_softening": (ThermalGrowth, ThermalSoftening, Creep),
}


def found(names: str) -> list[Effect]:
    """The effects that the search ends with, as fitted."""
    rows = measured(DEMO, HIDDEN[names], ROWS, 1)
    base = declared_model(DEMO).plus(*geometry(DEMO, rows))
    result = search(base, rows, library(DEMO, rows.context(), KINDS[names], base.terms).testable)
    for step in (settled, without_remainders):
        result, _ = step(result, lambda _: None)
    chosen = {key(term) for term in result.chosen}
    return [term for term in result.fit.model.effects if key(term) in chosen]


@pytest.mark.parametrize("names", HIDDEN)
def test_nothing_is_named_beside_what_is_hidden(names: str) -> None:
    made = found(names)
    assert sorted({term.name for term in made}) == names.split(", ")
    guides = [t for t in made if isinstance(t, TelescopeClearance) and t.joint == 3]
    assert len(guides) == (names == "telescope_clearance")
    for guide in guides:
        assert guide.clearance == pytest.approx(CLEARANCE, rel=0.2)
        assert guide.give == pytest.approx(PADS, rel=0.2)
