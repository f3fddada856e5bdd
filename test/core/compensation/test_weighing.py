"""The payload by what servos and a wrist sensor feel of it: registers, estimate, refusal."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.online import Readings
from longarm_comp.core.compensation.weighing import SD, Drives, Weighing, Wrist, feel_rest
from longarm_comp.core.effects.joint_term import joint_load
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.nodes.payload import drives
from longarm_comp.share import folder
from longarm_comp.sim.servo_emulator.joints import DATA_SHEETS
from studies.load import RESTS, reported_load, weigh_at_rests

SERVOS = folder("config") / "servo_driver.yaml"


@pytest.fixture(scope="module")
def full(arm: Arm) -> np.ndarray:
    joints = ServoConfig.load(SERVOS).joints
    return np.array([joints[name].full_effort for name in arm.joint_names], float)


@pytest.mark.parametrize("servo", DATA_SHEETS)
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_register_tells_load_friction_and_steps_of_the_data_sheet(
    servo: str, side: float
) -> None:
    """A drive gives more than the load where it came from below, less from above."""
    sheet = DATA_SHEETS[servo]
    share = reported_load(servo, -0.3, side, 1.0)
    assert share == pytest.approx(0.3 + side * sheet["hold_share"], abs=0.5 / sheet["load_units"])
    assert share * sheet["load_units"] == pytest.approx(round(share * sheet["load_units"]))
    assert 0 < sheet["hold_share"] < 0.1


@pytest.mark.parametrize("servo", DATA_SHEETS)
def test_servos_tell_a_payload_and_that_it_changed(servo: str, arm: Arm, full: np.ndarray) -> None:
    """Independent physics, bytes of the emulated servo; nobody says that the payload changes."""
    rests = list(weigh_at_rests(servo, arm, full, seed=1))
    first, before, after = rests[0], rests[RESTS - 1], rests[RESTS]
    assert first.sigma_kg > 3.0 * before.sigma_kg, "rests tell friction from payload"
    for found in (before, after, rests[-1]):
        assert found.tells
        assert abs(found.felt_kg - found.kg) < 3.0 * found.sigma_kg < 0.15
    assert not any(found.contradicts for found in rests[:RESTS])
    assert all(found.contradicts for found in rests[RESTS:])


class Bench:
    """An ideal arm: torques of the model itself at a payload, and friction of a size."""

    def __init__(self, arm: Arm, seed: int = 0) -> None:
        self.model, self.rng, self.friction = declared_model(arm), np.random.default_rng(seed), 0.0

    def rest(self, kg: float, friction: np.ndarray, *, sided: bool = True) -> tuple:
        arm = self.model.arm
        q, side = self.rng.uniform(arm.lower, arm.upper), self.rng.choice([-1.0, 1.0], arm.n)
        at = self.model.posture(tuple(q), Context(columns={"payload_kg": kg}))
        load = np.array([joint_load(at, row) for row in arm.commanded], float)
        known = Context(approach=tuple(side)) if sided else Context()
        return self.model, q, known, friction * side - load


def test_a_payload_that_friction_hides_is_not_told(arm: Arm, full: np.ndarray) -> None:
    bench, now = Bench(arm), Weighing()
    large = Drives(0.9 * full, full / 1000)
    for _ in range(2):
        now = now.with_rest(feel_rest(*bench.rest(0.25, 0.9 * full, sided=False), large))
    assert now.payload is not None and not now.payload.tells(0.25)
    assert not now.contradicts(0.0) and not now.contradicts(1.0)


def test_an_arm_whose_drives_say_nothing_is_not_weighed(arm: Arm) -> None:
    bench, nothing = Bench(arm), np.full(arm.n, np.nan)
    now = Weighing().with_rest(
        feel_rest(*bench.rest(0.25, np.zeros(arm.n)), Drives(nothing, nothing))
    )
    assert now.payload is not None and np.isinf(now.payload.sigma_kg)
    assert not now.payload.tells(1e3)


def test_a_wrist_sensor_weighs_beyond_its_frame(arm: Arm) -> None:
    """Its zero error is alike from rest to rest, so rests tell it from the payload."""
    bench, none = Bench(arm), np.full(arm.n, np.nan)
    row, zero = len(arm.joints), np.array([0.5, -0.3, 0.4])
    now = Weighing()
    for _ in range(8):
        model, q, known, _ = bench.rest(0.6, np.zeros(arm.n))
        at = model.posture(tuple(q), Context(columns={"payload_kg": 0.6}))
        force = np.array(at.force(at.frame(row)), float) + zero
        now = now.with_rest(
            feel_rest(model, q, known, none, Drives(none, none), Wrist(row, force, 0.5))
        )
    found = now.payload
    assert found is not None and found.tells(0.25)
    assert abs(found.kg - 0.6) < 3.0 * found.sigma_kg < 0.1
    assert now.contradicts(0.25) and not now.contradicts(0.6)


def test_another_payload_that_is_told_begins_anew(arm: Arm, full: np.ndarray) -> None:
    bench, told_free = Bench(arm), Drives(0.01 * full, full / 1000)
    now = Weighing()
    for kg in (0.25, 0.25, 0.4):
        if kg == 0.4:
            now = now.change_payload()
            assert now.payload is None
        now = now.with_rest(feel_rest(*bench.rest(kg, 0.01 * full), told_free))
    assert now.payload is not None and now.payload.rests == 1
    assert now.payload.kg == pytest.approx(0.4, abs=3.0 * now.payload.sigma_kg)


def test_what_a_command_does_not_know_of_the_payload_widens_it(arm: Arm) -> None:
    model = declared_model(arm)
    target = model.tip(arm.mid)
    known = Context(columns={"payload_kg": 0.3})
    unsure = Context(columns={"payload_kg": 0.3, SD: 0.1})
    sure, wide = (compensate(model, None, target, context=c)[0] for c in (known, unsure))
    heavy, light = (
        model.tip(wide.command, Context(columns={"payload_kg": kg})) for kg in (0.4, 0.2)
    )
    np.testing.assert_allclose(sure.command, wide.command)
    grown = wide.sigma**2 - np.nan_to_num(sure.sigma) ** 2
    np.testing.assert_allclose(grown, (0.5 * (heavy - light)) ** 2, rtol=1e-3, atol=1e-12)
    assert "the payload is known to 0.100 kg only" in wide.reason


def test_the_latest_word_on_the_payload_counts(arm: Arm) -> None:
    told_once = Readings().with_reading("payload", {"payload_kg": 0.2}, 10.0)
    weighed_later = told_once.with_reading("load", {"payload_kg": 0.5, SD: 0.1}, 20.0)
    model = Model(arm)
    assert weighed_later.context(model, 25.0, 60.0).columns["payload_kg"] == 0.5
    assert weighed_later.context(model, 75.0, 60.0).columns["payload_kg"] == 0.5, "one is fresh"
    silent = weighed_later.with_reading("payload", {"payload_kg": 0.3}, 21.0).with_reading(
        "load", {}, 21.0
    )
    assert silent.context(model, 25.0, 60.0).columns == {"payload_kg": 0.3}


def test_what_servos_tell_is_read_from_the_drivers_file(arm: Arm, tmp_path: Path) -> None:
    known = drives(str(SERVOS), arm)
    assert known.friction[0] == pytest.approx(29.4 * 0.18 / 2.7)
    assert known.step[0] == pytest.approx(0.0294)
    text = SERVOS.read_text("utf-8").replace(", full_effort: 29.4", "")
    (tmp_path / "servos.yaml").write_text(text, "utf-8")
    assert np.isnan(drives(str(tmp_path / "servos.yaml"), arm).friction[0])
    assert np.isnan(drives("", arm).friction).all()


def test_friction_of_many_rests_is_forgotten(arm: Arm, full: np.ndarray) -> None:
    bench, free = Bench(arm), Drives(0.01 * full, full / 1000)
    rest = feel_rest(*bench.rest(0.25, 0.01 * full), free)
    now = replace(Weighing(), rests=(rest,) * 50, loads=(0,) * 50).with_rest(rest)
    assert len(now.rests) == len(now.loads) == 40


def test_a_rest_of_a_payload_that_nothing_carries_is_not_finite(arm: Arm, full: np.ndarray) -> None:
    """It is dropped on the graph: one such rest would leave no estimate ever again."""
    drives_ = Drives(0.04 * full, 0.001 * full)
    model, q, known, effort = Bench(arm).rest(0.25, 0.01 * full)
    assert feel_rest(model, q, known, effort, drives_).finite
    assert feel_rest(model, q, known, effort, drives_, Wrist(7, np.zeros(3), 1.0)).finite
    for kg in (1e308, np.inf):
        there = replace(known, columns={"payload_kg": kg})
        with np.errstate(all="ignore"):
            assert not feel_rest(model, q, there, effort, drives_).finite
