"""The payload by the load of servos, by servo: simulated arms, emulated servos.

The payload changes half-way without a word.  Torques are those of the true arm; a servo holds them
with the friction of its data sheet, from the side that its joint came from, and tells them in the
steps of its register.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.weighing import Drives, Weighing, feel_rest
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.devices.servo_bus.registry import models, protocols
from longarm_comp.devices.servo_bus.state import ServoAlarm
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.share import folder
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.servo_emulator.joints import DATA_SHEETS
from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec
from longarm_comp.sim.servo_emulator.wire import RegisterWire
from longarm_comp.sim.servo_emulator.wires import list_wires
from studies.commands import Figures, Show, arms_option, study_command
from studies.random_arms import random_arm

PAYLOADS_KG = (0.25, 0.8)
RESTS = 12
SCATTER = 0.3
"""Part of the friction that differs from rest to rest."""


@dataclass(frozen=True)
class Weighed:
    """The outcome of a rest: what is carried, what is felt, whether that tells a payload."""

    rest: int
    kg: float
    felt_kg: float
    sigma_kg: float
    tells: bool
    contradicts: bool


def weigh_at_rests(servo: str, arm: Arm, full_effort: np.ndarray, seed: int) -> Iterator[Weighed]:
    """Yield rests of one arm.

    Args:
        servo: model, of those in `DATA_SHEETS`.
        full_effort: (n,) at the joints, N m and N.
    """
    rng, model, kind = np.random.default_rng([seed, 28]), declared_model(arm), models()[servo]
    true, now = TrueArm(arm, (), steps=2), Weighing()
    size = full_effort * (kind.friction or np.nan)
    drives = Drives(size, full_effort / kind.full_load)
    for k in range(RESTS * len(PAYLOADS_KG)):
        kg = PAYLOADS_KG[k // RESTS]
        q, side = rng.uniform(arm.lower, arm.upper), rng.choice([-1.0, 1.0], arm.n)
        torque = true.settle(q, TrueContext(side, 22.0, kg, 0.0)).torques[0]
        parts = rng.uniform(1.0 - SCATTER, 1.0, arm.n)
        shares = zip(torque / full_effort, side, parts, strict=True)
        load = np.array([reported_load(servo, *each) for each in shares])
        context = Context(approach=tuple(side), columns={"temperature_c": 22.0})
        now = now.with_rest(feel_rest(model, q, context, load * full_effort, drives))
        found = now.payload
        assert found is not None
        declared = PAYLOADS_KG[0]
        yield Weighed(
            k + 1, kg, found.kg, found.sigma_kg, found.tells(declared), now.contradicts(declared)
        )


def reported_load(servo: str, load: float, side: float, part: float) -> float:
    """Return the share of full effort that a resting servo's registers report under a load."""
    kind, sheet = models()[servo], dict(DATA_SHEETS[servo])
    changed: dict[str, Any] = sheet | {"hold_share": part * sheet["hold_share"]}
    spec = replace(MotorSpec(), **changed)
    motor = Motor(spec, 1000.0)
    motor.switch(True)
    motor.approach, motor.external_load = int(side), load
    motor.advance(0.01)
    wire, dialect = list_wires()[kind.protocol], protocols()[kind.protocol]()
    assert isinstance(wire, RegisterWire)
    _, data = wire.read(wire.device(1, motor), dialect.state.address, dialect.state.length)
    return dialect.state_of(data, ServoAlarm.NONE, kind).load


def table(arm: Arm, full_effort: np.ndarray, count: int) -> list[Mapping[str, Any]]:
    """Compute by servo the errors of the estimates over random arms."""
    rows: list[Mapping[str, Any]] = []
    for servo in DATA_SHEETS:
        each = [
            list(weigh_at_rests(servo, random_arm(np.random.default_rng(k), arm), full_effort, k))
            for k in range(count)
        ]
        row: dict[str, Any] = {"servo": servo}
        for rests in (1, 4, RESTS):
            off = np.array([w[rests - 1].felt_kg - w[rests - 1].kg for w in each])
            row[f"rms_kg_{rests}"] = float(np.sqrt((off**2).mean()))
            row[f"sigma_kg_{rests}"] = float(np.mean([w[rests - 1].sigma_kg for w in each]))
        change = [next((w.rest - RESTS for w in a[RESTS:] if w.contradicts), None) for a in each]
        row["noticed_after"] = max((c for c in change if c is not None), default=None)
        row["never"] = change.count(None)
        row["false"] = sum(w.contradicts for a in each for w in a[:RESTS])
        rows.append(row)
    return rows


@study_command(arms_option(8, "Arms."))
def command(arms: int, show: Show) -> Figures:
    """Estimate a payload by the loads that servos report: error and sigma by servo, kg.

    After 1, 4 and 12 rests with 0.25 kg; then 0.8 kg are carried and nobody says it.

    \b
    Example:
      longarm study load --arms 8
    """
    arm = Arm.load(folder("config") / "arm_demo.yaml")
    joints = ServoConfig.load(folder("config") / "servo_driver.yaml").joints
    full = np.array([joints[name].full_effort for name in arm.joint_names], float)
    rows = table(arm, full, arms)
    return Figures({"rows": rows}, {"Payload by the servos' loads, 0.25 kg, then 0.8 kg": rows})
