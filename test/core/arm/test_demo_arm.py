"""The two files of the demonstration's arm: one declares the steps of its servos."""

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.share import folder

STEPS = ("step_deg", "step_m")


def test_the_demonstration_declares_what_its_servos_do() -> None:
    plain, stepped = (
        read_yaml(folder("config") / name) for name in ("arm_demo.yaml", "arm_demo_steps.yaml")
    )
    for joint in stepped["joints"]:
        assert sum(joint.pop(key, 0.0) > 0 for key in STEPS) == 1
    assert stepped == plain


def test_the_steps_are_ticks_of_the_servos() -> None:
    arm = Arm.load(folder("config") / "arm_demo_steps.yaml")
    servos = ServoConfig.load(folder("config") / "servo_driver.yaml")
    ticks = [servos.joints[name].si_per_tick for name in arm.joint_names]
    np.testing.assert_allclose(arm.steps, ticks, rtol=1e-7)
    at = np.array([0.1, 0.2, 0.05, 0.3, -0.4, 0.1, 0.02])
    stood = [
        servos.joints[name].to_si(servos.joints[name].to_ticks(value))
        for name, value in zip(arm.joint_names, at, strict=True)
    ]
    assert stood == pytest.approx(np.round(at / arm.steps) * arm.steps, abs=1e-8)
