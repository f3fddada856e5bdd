"""Trained in one condition, commanded in another: one small arm, and what the claim is made of."""

from __future__ import annotations

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.compensation.result import Method
from longarm_comp.sim.hidden.drives import FrictionHysteresis
from studies import conditions
from studies.conditions import ALSO, CONDITIONS, NETWORK, TOGETHER, claims, one_arm, rows_of, table
from studies.table1_bench import SETTINGS, Bench, Outcome, as_printed

FEW = 60
SHORT = (
    as_printed("Deflection only", Method.DEFLECTION, (15.39, 215.97)),
    as_printed(NETWORK, Method.NETWORK, (12.66, 214.37), FEW),
    as_printed(TOGETHER, Method.BOTH, (9.98, 180.81), FEW),
)


@pytest.mark.long
def test_one_arm_is_commanded_in_every_condition(arm: Arm) -> None:
    found = one_arm(arm, 3, 0, SHORT, poses=FEW)
    assert list(found) == [c.name for c in CONDITIONS]
    for k, setting in enumerate(SHORT):
        sizes = [found[c.name][k].tip.mean for c in CONDITIONS]
        assert len(set(sizes)) == len(CONDITIONS), f"{setting.row}: a condition changes nothing"
    rows = table([found], SHORT)
    assert [row["row"] for row in rows] == [s.row for s in SHORT]
    network = rows[1]
    assert network["+0.5 kg, |z| mm"] > network["as trained, |z| mm"]


def test_a_condition_is_of_the_bench_alone(arm: Arm) -> None:
    bench = Bench.draw(arm, 3, 0, 5, also=ALSO)
    other = CONDITIONS[-1].of(bench)
    assert other.payload_kg - bench.payload_kg == pytest.approx(0.5)
    assert other.temperature_c - bench.temperature_c == pytest.approx(15.0)
    lags = [
        e.lag for b in (bench, other) for e in b.true.hidden if isinstance(e, FrictionHysteresis)
    ]
    assert np.count_nonzero(lags[1] - lags[0]) == 1
    assert (lags[1] - lags[0]).max() == pytest.approx(6e-3)
    assert any(e.name == "thermal_growth" for e in bench.true.hidden)


def test_the_claim_is_about_what_is_lost_by_arm() -> None:
    """An arm that is worse throughout does not hide that it loses less."""
    settings = rows_of((NETWORK, TOGETHER))
    assert settings == tuple(s for s in SETTINGS if s.row in (NETWORK, TOGETHER))

    def outcome(row: str, z: float) -> Outcome:
        errors = Errors.of(np.array([[0.0, 0.0, z], [0.0, 0.0, -z]]))
        return Outcome(row, errors, errors, 0)

    def arm(level: float, more: float) -> dict[str, list[Outcome]]:
        return {
            "as trained": [outcome(NETWORK, level), outcome(TOGETHER, level)],
            "+0.5 kg": [outcome(NETWORK, level + 5e-3 + more), outcome(TOGETHER, level + 1e-3)],
            "worn": [outcome(NETWORK, level), outcome(TOGETHER, level + 2e-3 + more)],
            "open": [outcome(NETWORK, level + more), outcome(TOGETHER, level)],
        }

    arms = [arm(0.01, 1e-4), arm(0.03, -1e-4), arm(0.05, 0.0)]
    held, broken, unsure = claims(arms, settings)
    assert (held["claim"], broken["claim"], unsure["claim"]) == ("holds", "contradicted", "open")
    assert held["difference_mm"] == pytest.approx(-4.0)
    assert (held["together_loses_mm"], held["network_loses_mm"]) == pytest.approx((1.0, 5.0))
    assert set(conditions.ROWS) <= {s.row for s in SETTINGS}
