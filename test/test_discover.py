"""What the library lacks is found: place, component and function, proven or left alone."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hidden_arm import white
from small_arm import ARM as SMALL

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.calibrate import declared_model, stages
from longarm_comp.core.identify.discover.discovery import Discovery, discover
from longarm_comp.core.identify.fit import ModelFit
from longarm_comp.share import folder
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State, TrueContext
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.hidden.outside import HosePull, PumpShake, RubberStop

ROWS, HELD_OUT = 160, 80
DEMO = Arm.load(folder("config") / "arm_demo.yaml")


def measured(arm: Arm, hidden: tuple[HiddenEffect, ...], n: int, seed: int) -> Session:
    """Poses all over the box, with what such an arm would record, and 0.2 mm of noise."""
    rng = np.random.default_rng(seed)
    q = sobol(arm, n, rng).q
    t = np.linspace(0.0, 15.0 * n, n)
    context = TrueContext(t_s=t, temperature_c=arm.reference_temperature_c + 3 * np.sin(t / 700))
    xyz = TrueArm(arm, hidden, steps=2).tip(q, context) + white(rng, n)
    state = State.of(arm, q, context)
    columns = {"t_s": t, "temperature_c": state.temperature_c}
    for effect in hidden:
        columns |= effect.readings(state)
    return Session.record(q, xyz, columns=columns)


def calibrated(arm: Arm, session: Session) -> ModelFit:
    *_, (_, fitted) = stages(declared_model(arm), session)
    return fitted


@cache
def found(arm_name: str, *hidden: HiddenEffect, seed: int = 3) -> Discovery | None:
    arm = {"small": SMALL, "demo": DEMO}[arm_name]
    fitted = calibrated(arm, measured(arm, hidden, ROWS, seed))
    held_out = measured(arm, hidden, HELD_OUT, seed + 100)
    return discover(fitted, None, 100, held_out, None, np.random.default_rng(0))


def test_a_hose_is_a_force_at_its_place_with_its_size() -> None:
    made = found("demo", HosePull(row=5, first=1, second=4, pull=24.0))
    assert made is not None
    assert made.kept
    (cause,) = made.found
    assert cause.where[0] == "joint 5, force y"
    assert cause.terms[0].function == "linear(q2) * linear(q5)"
    (amount,) = cause.amounts
    assert amount.unit == "N/rad^2"
    assert amount.ci95[0] < 24.5
    assert amount.ci95[1] > 23.5
    assert "N/rad^2 x q2 x q5" in cause.sentence
    assert "behaves like a hose or cable that pulls" in cause.sentence
    assert cause.compensated
    rows = made.proof.rows
    assert rows["with_effects"].rms < 0.5 * rows["calibrated"].rms


def test_a_stop_is_a_contact_with_its_threshold() -> None:
    made = found("small", RubberStop(joint=1, begins=0.8, holds=0.1))
    assert made is not None
    assert made.kept
    first = made.found[0].terms[0]
    factor = first.of.factors[0]
    assert factor.of == "q2"
    assert factor.word == "above"
    assert factor.threshold == pytest.approx(0.8, abs=0.05)
    assert made.found[0].reading == "behaves like a contact, a stop or a taut cable"


def test_a_recorded_column_that_drives_the_error_is_found_on_its_axis() -> None:
    made = found("small", PumpShake(sway=2e-3, waves=6.0))
    assert made is not None
    assert made.kept
    (cause,) = made.found
    assert {f.of for t in cause.terms for f in t.of.factors} == {"pump_bar"}
    assert all(w.endswith(" x") for w in {a.where for a in cause.amounts})
    assert "something that the recorded column drives" in cause.reading


@pytest.mark.parametrize("seed", range(3))
def test_where_nothing_is_hidden_nothing_is_found(seed: int) -> None:
    made = found("small", seed=seed)
    assert made is None or not made.kept
