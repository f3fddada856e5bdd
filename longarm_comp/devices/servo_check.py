"""Checks of the registers in a servo's memory, before the servo is commanded."""

from longarm_comp.core.errors import JobError
from longarm_comp.devices.servo_bus.memory import Register, ServoMemory
from longarm_comp.devices.servo_joint import JointConfig

_CURE = "set it with the maker's tool"


def check_memory(name: str, joint: JointConfig, kept: ServoMemory) -> None:
    """Check the registers that decide how the servo understands goals and speeds.

    Raises:
        JobError: naming a register with which commands would be misunderstood or limited, its
            value, and the allowed values.
    """
    for register in kept.registers:
        if register.allowed and kept.values[register.name] not in register.allowed:
            allowed = " or ".join(map(str, register.allowed))
            raise _refusal_of(
                name, joint, kept, register, f"{allowed}: {register.otherwise}; {_CURE}"
            )
    most = kept.speed_ticks_s
    if most is not None and joint.max_speed_ticks_s > most:
        fastest = f"max_velocity up to {most * joint.si_per_tick:.4g} {joint.unit}/s"
        raise JobError(
            f"{_who_is(name, joint)} does not go as fast as its joint may; allowed: {fastest}, or "
            f"another limit in its memory ({kept.notable})",
            max_velocity=joint.max_velocity,
        )
    if joint.multi_turn and _is_narrower(joint, kept):
        raise JobError(
            f"{_who_is(name, joint)} keeps limits within one turn, which multi_turn: true would "
            f"lift; allowed: multi_turn: false, or no limits ({_CURE}) ({kept.changes})"
        )


def check_placed(name: str, joint: JointConfig, kept: ServoMemory) -> None:
    """Check that the registers that decide the meaning of positions have not changed.

    Raises:
        JobError: a register differs from its value when ``zero_ticks`` was measured.
    """
    for register in kept.registers:
        wanted = joint.stored.get(register.name, register.factory)
        if register.places and kept.values[register.name] != wanted:
            allowed = (
                f"{wanted}, as it was when zero_ticks was measured; `longarm servo setup` measures "
                "again"
            )
            raise _refusal_of(name, joint, kept, register, allowed)


def check_reach(name: str, joint: JointConfig, kept: ServoMemory) -> None:
    """Check that the servo's own limits let the joint reach its configured limits.

    Raises:
        JobError: they do not.
    """
    low, high = joint.goal_range
    if kept.goals is not None and not joint.multi_turn:
        low, high = max(low, kept.goals[0]), min(high, kept.goals[1])
    ends = joint.tick_limits
    limited = _is_narrower(joint, kept) or bool(kept.placing)
    if limited and not (low <= ends[0] and ends[1] <= high):
        reach = sorted((joint.to_si(low), joint.to_si(high)))
        raise JobError(
            f"{_who_is(name, joint)} takes goals {low} to {high}, and its joint's limits are goals "
            f"{ends[0]} to {ends[1]}; allowed: lower and upper of {reach[0]:.4g} to {reach[1]:.4g} "
            f"{joint.unit}, or other registers in its memory ({kept.changes})"
        )


def _is_narrower(joint: JointConfig, kept: ServoMemory) -> bool:
    """Tell whether the servo's own goal limits are narrower than one turn."""
    low, high = joint.servo.single_turn
    return kept.goals is not None and (kept.goals[0] > low or kept.goals[1] < high)


def _refusal_of(
    name: str, joint: JointConfig, kept: ServoMemory, register: Register, allowed: str
) -> JobError:
    return JobError(f"{_who_is(name, joint)}: {kept.describe(register)}; allowed: {allowed}")


def _who_is(name: str, joint: JointConfig) -> str:
    return f"servo {joint.servo_id} of {name}"
