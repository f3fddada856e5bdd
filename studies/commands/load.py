"""``longarm study load``."""

from __future__ import annotations

from studies.commands import shape


@shape.study(shape.arms(8, "Arms."))
def command(arms: int, show: shape.Show) -> shape.Figures:
    """How well the loads that servos report tell a payload: error and sigma by servo, kg.

    After 1, 4 and 12 rests with 0.25 kg; then 0.8 kg are carried and nobody says it.

    \b
    Example:
      longarm study load --arms 8
    """
    import numpy as np

    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.devices.servo_config import ServoConfig
    from longarm_comp.share import folder
    from studies.load import table

    arm = Arm.load(folder("config") / "arm_demo.yaml")
    joints = ServoConfig.load(folder("config") / "servo_driver.yaml").joints
    full = np.array([joints[name].full_effort for name in arm.joint_names], float)
    rows = [dict(row) for row in table(arm, full, arms)]
    return shape.Figures(
        {"rows": rows}, {"Payload by the servos' loads, 0.25 kg, then 0.8 kg": rows}
    )
