"""Names contested by one cause without a name: it takes their place, opens them, or is none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from discover_rows import DEMO, HELD_OUT, ROWS, calibrated, measured
from small_arm import ARM as SMALL

from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.base_compliance import BaseCompliance
from longarm_comp.core.effects.bearing_tilt import BearingTilt
from longarm_comp.core.effects.camera_drift import CameraDrift
from longarm_comp.core.identify import diagnose as core
from longarm_comp.core.identify.discover.discovery import (
    contest,
)
from longarm_comp.core.identify.discover.hold_out import borne_out, helps_between
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.proof import Proof
from longarm_comp.sim.hidden import loads
from studies.discover import set_up


def test_a_rival_at_another_part_of_the_arm_opens_a_name() -> None:
    """A soft base and a soft bearing above it move the tip alike; the repair is another."""
    hidden = (loads.BaseCompliance(np.array([6e-3, 6e-3])),)
    plain = calibrated(DEMO, measured(DEMO, hidden, ROWS, 3))
    held_out = measured(DEMO, hidden, HELD_OUT, 103)
    rivals = {}
    for name in (BearingTilt(joint=1), BaseCompliance()):
        named = fit(plain.model.plus(name), plain.session)
        rivals[name.name] = contest(
            named, plain, 100, lambda: held_out, None, np.random.default_rng(0)
        )
    open_ = rivals["bearing_tilt"]
    assert open_ is not None
    assert open_.rival
    assert open_.found[0].where[0] == "base, give"
    assert rivals["base_compliance"] is None


def test_names_that_imitate_a_cause_give_way_to_it() -> None:
    """Tilting bearings imitate a curved window so well that no structure is left."""
    setting = set_up(DEMO, "window_glass", "grid", 2, ROWS)
    result = core.diagnose(DEMO, setting.train, test=setting.held_out, kinds=(BearingTilt,))
    assert not result.findings
    assert (result.verdict, result.search.chosen != ()) == ("unknown", True)
    added = result.added
    assert added is not None
    assert added.without == ("bearing_tilt",)
    assert added.found[0].where[0] == "what the camera sees, z"
    assert added.inputs == ("seen_x",)
    assert not added.found[0].compensated
    on, truth = setting.off
    off_by = [
        np.linalg.norm(model.measured(on.q, on.context()) - truth, axis=1).mean()
        for model in (result.models["with_effects"], result.model)
    ]
    assert off_by[1] < 0.5 * off_by[0]


def test_a_true_name_is_not_contested() -> None:
    """A base that moves with time does for a drift of the camera, and no better."""
    still = measured(SMALL, (), ROWS, 3)
    moved = np.outer(still.columns["t_s"], [4e-7, -2e-7, 3e-7])
    plain = calibrated(SMALL, dataclasses.replace(still, xyz=still.xyz + moved))
    named = fit(plain.model.plus(CameraDrift()), plain.session)
    sealed = pytest.fail
    assert contest(named, plain, 100, sealed, None, np.random.default_rng(0)) is None


@pytest.mark.parametrize(
    ("n", "by", "outcome"),
    [(4, 1.0, "rival"), (3 * HELD_OUT, 1.0, "kept"), (HELD_OUT, -3.0, "refuted")],
)
def test_a_name_is_open_where_the_hold_out_does_not_decide(n: int, by: float, outcome: str) -> None:
    """The camera is said to drift; what it sees follows the temperature."""

    def warmed(n: int, seed: int, by: float) -> Session:
        rows = measured(SMALL, (), n, seed)
        warmth = rows.columns["temperature_c"] - SMALL.reference_temperature_c
        moved = by * np.outer(warmth, [6e-5, -4e-5, 1.2e-4])
        return dataclasses.replace(rows, xyz=rows.xyz + moved)

    plain = calibrated(SMALL, warmed(ROWS, 3, 1.0))
    named = fit(plain.model.plus(CameraDrift()), plain.session)
    rng = np.random.default_rng(0)
    found = contest(named, plain, 100, lambda: warmed(n, 8, by), None, rng)
    if outcome == "refuted":
        assert found is None
        return
    assert found is not None
    assert (found.rival, found.kept) == (outcome == "rival", outcome == "kept")
    assert found.without == ("camera_drift",)


@pytest.mark.parametrize(
    ("rows", "worse", "kept"), [(12, 0.0, True), (12, 2.0, False), (4, 2.0, True)]
)
def test_poses_between_the_levels_of_a_grid_must_not_be_worse(
    rows: int, worse: float, kept: bool
) -> None:
    """Unless there are too few of them to tell."""
    before = np.tile([1e-3, 0.0, 0.0], (40, 1))
    between = np.arange(40) < rows
    after = np.where(between[:, None], worse * before, 0.0)
    errors = {"calibrated": before, "with_effects": after}
    proof = Proof(errors, errors, {}, True, 1.0, 0.0, 1.0, off_levels=between)
    assert helps_between(proof) == kept
    assert borne_out(proof, 900.0) == kept
