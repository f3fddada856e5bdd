"""``longarm servo setup``."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_table
from longarm_comp.core.errors import JobError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from longarm_comp.cli.setup_answers import SetupAnswers
    from longarm_comp.devices.servo_bus import Scan
    from longarm_comp.devices.servo_config import ServoConfig
    from longarm_comp.devices.servo_joint import JointConfig
    from longarm_comp.devices.servo_setup import ServoSetup, Sweep


@click.command()
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
@options.servo_line
@click.option("--id", "id_of", multiple=True, metavar="JOINT=ID", help="Servo id of a joint.")
@click.option(
    "--sweep-s",
    type=click.FloatRange(0.0),
    default=None,
    help="Longest time for the sweep; it ends when every joint covered its range and rests.",
)
@click.option("--no-sweep", is_flag=True, help="Skip the sweep, for joints that no hand can turn.")
@click.option("--zero", type=click.Choice(["pose", "sweep"]), help="Where zeros come from.")
@click.option(
    "--pose", multiple=True, metavar="JOINT=VALUE", help="Held pose, deg or mm. Default: 0."
)
@click.option(
    "--stops",
    multiple=True,
    metavar="JOINT=LOW..HIGH",
    help="Joint values at the ends of the sweep, deg or mm. Default: the declared limits.",
)
@click.option(
    "--direction",
    multiple=True,
    metavar="JOINT=+|-",
    help="+ if the ticks grow with the joint value, else -.",
)
@click.option("--nudge", default=5.0, show_default=True, help="Size of a nudge, deg or mm.")
@click.option("--yes", is_flag=True, help="Do not wait at each step: the arm is held or supported.")
@options.as_json
def command(folder: Path, as_json: bool, **answers: Any) -> None:
    """Find ids, zeros and directions of DIR's servos, and write DIR/servo_driver.yaml.

    The steps are: find the port; scan for servos; switch the torque off; move every joint by hand
    through its travel, watching a live table; take the zeros from a pose that you hold, or from the
    ends of the travel; nudge each joint and answer which way it went. Then the file is written in
    one step, read again, and the joints' values are shown. Every question is also an option. The
    torque is off at the end and after an interruption; an interruption leaves the file as it was.

    \b
    Examples:
      longarm servo setup my_arm
      longarm servo setup my_arm --port /dev/ttyUSB0 --no-sweep --zero pose --yes \\
        --pose joint2=30 --direction joint1=+ --direction joint2=-
    """
    from longarm_comp.cli.dialogue import ended_by_signals
    from longarm_comp.cli.setup_answers import SetupAnswers

    given = SetupAnswers.of(folder, **answers)
    with ended_by_signals():
        _run(folder, given, as_json)


def _run(folder: Path, given: SetupAnswers, as_json: bool) -> None:
    from longarm_comp.arm_folder.servos import SERVOS, with_joints, write_servos
    from longarm_comp.devices.servo_bus import open_bus
    from longarm_comp.devices.servo_config import ServoConfig
    from longarm_comp.devices.servo_setup import ServoSetup

    file, bus = folder / SERVOS, given.config.bus
    line = _line(given)
    joints = given.joints_on(line)
    given.dialogue.go_on("The torque goes off: hold or support the arm.")
    servo_bus = open_bus(
        line.protocol, line.port, line.baudrate,
        {joint.servo_id: joint.servo for joint in joints.values()},
        bus.reply_timeout_s, bus.retries,
    )  # fmt: skip
    with closing(servo_bus), ServoSetup(servo_bus, joints).safely() as setup:
        sweep = {} if given.flags["no_sweep"] else _swept(setup, given)
        pose, rest = _held(setup, given)
        directions = given.directions | _directions(setup, given)
    joints = _with_zeros(setup.joints, directions, sweep, pose, rest, given)
    text = with_joints(
        file.read_text("utf-8"),
        {"protocol": line.protocol, "port": line.port, "baudrate": line.baudrate},
        joints, file,
    )  # fmt: skip
    _show(joints, sweep)
    given.dialogue.go_on(f"{file} will be written.")
    source = "pose" if rest else "sweep"
    write_servos(folder, text, joints, {"zero": source, "swept": bool(sweep)})
    reads = _read_back(ServoConfig.load(file))
    if as_json:
        found = {
            name: {
                **{k: getattr(joint, k) for k in ("servo_id", "model", "direction", "zero_ticks")},
                "travel": _ends(joint, sweep), "now": reads[name],
            }
            for name, joint in joints.items()
        }  # fmt: skip
        print_json({"file": str(file), "port": line.port, "protocol": line.protocol,
                    "baudrate": line.baudrate, "joints": found})  # fmt: skip
        return
    rows = [(name, joints[name].servo_id, _by_hand(joints[name], v)) for name, v in reads.items()]
    print_table(f"{file}, read back", ("joint", "id", "now"), rows)
    note(f"next: longarm check {folder}")


def _line(given: SetupAnswers) -> Scan:
    """The bus: as the file has it, or whatever answers."""
    from longarm_comp.cli.servo import asked_port, refuse_clashes, scanned, show

    bus, flags = given.config.bus, given.flags
    port = asked_port(given.dialogue, flags["port"], bus.port)
    protocol, baud, ids = (flags[name] for name in ("protocol", "baud", "ids"))
    try:
        found = scanned(port, protocol or bus.protocol, baud or bus.baudrate, ids)
    except JobError:
        if protocol and baud:
            raise
        found = scanned(port, protocol, baud, ids)
    show(found, on_stderr=True)
    refuse_clashes(found)
    return found


def _swept(setup: ServoSetup, given: SetupAnswers) -> Sweep:
    from longarm_comp.cli.sweep_table import swept
    from longarm_comp.devices.servo_setup import sweep_faults

    sweep = swept(setup, given.flags["sweep_s"])
    faults = [
        fault
        for name, joint in setup.joints.items()
        for fault in sweep_faults(name, joint, sweep[joint.servo_id])
    ]
    if faults:
        raise JobError("; ".join(faults))
    return sweep


def _held(setup: ServoSetup, given: SetupAnswers) -> tuple[dict[str, float], dict[int, float]]:
    """Joint values of the held pose (rad, m) and ticks by id; no ticks: zeros from the sweep."""
    dialogue = given.dialogue
    source = given.flags["zero"] or (
        "pose" if given.flags["no_sweep"]
        else dialogue.choose("--zero", "zeros from", ("pose", "sweep"), "pose")
    )  # fmt: skip
    if source == "sweep":
        return {}, {}
    pose = {
        name: given.pose.get(name, min(max(0.0, joint.lower), joint.upper))
        for name, joint in setup.joints.items()
    }
    said = ", ".join(f"{name} {_by_hand(setup.joints[name], v)}" for name, v in pose.items())
    dialogue.go_on(f"Put the arm into this pose and hold it still (another: --pose): {said}.")
    return pose, setup.rest()


def _directions(setup: ServoSetup, given: SetupAnswers) -> dict[str, int]:
    """Of the joints whose direction is not given: each is nudged, and the user says which way."""
    from longarm_comp.devices.servo_setup import hand_unit

    open_ones = [name for name in setup.joints if name not in given.directions]
    if not open_ones:
        return {}
    found: dict[str, int] = {}
    given.dialogue.go_on("The torque goes on; each joint makes a small move. Stand clear.")
    setup.hold()
    answers = ("+", "-", "again", *setup.joints)
    text = "in which direction did it go, by arm.yaml? (if another joint moved, type its name)"
    while left := [name for name in open_ones if name not in found]:
        name = left[0]
        nudge = setup.nudge(name, given.flags["nudge"] * hand_unit(setup.joints[name])[0])
        answer = given.dialogue.choose("--direction", f"{name}: {text}", answers, "again")
        setup.back(nudge)
        if answer in ("+", "-"):
            found[name] = nudge.sign if answer == "+" else -nudge.sign
        elif answer in setup.joints and answer != name:
            setup.exchange(name, answer)
            note(f"{name} and {answer} exchange their servos")
            found.pop(answer, None)
    given.dialogue.go_on("The torque goes off again: hold or support the arm.")
    return found


def _with_zeros(
    joints: Mapping[str, JointConfig],
    directions: Mapping[str, int],
    sweep: Sweep,
    pose: Mapping[str, float],
    rest: Mapping[int, float],
    given: SetupAnswers,
) -> dict[str, JointConfig]:
    from longarm_comp.devices.servo_setup import beyond_travel, zero_from_pose, zero_from_sweep

    made = {}
    for name, blind in joints.items():
        joint = blind.having(direction=directions[name])
        if rest:
            zero = zero_from_pose(joint, rest[joint.servo_id], pose[name])
        else:
            zero = zero_from_sweep(name, joint, sweep[joint.servo_id], given.stops.get(name))
        made[name] = joint.having(zero_ticks=zero)
        if sweep:
            for text in beyond_travel(name, made[name], sweep[joint.servo_id]):
                note(text)
    return made


def _show(joints: Mapping[str, JointConfig], sweep: Sweep) -> None:
    rows = []
    for name, joint in joints.items():
        ends = _ends(joint, sweep)
        travel = " to ".join(_by_hand(joint, value) for value in ends) if ends else ""
        sign = "+" if joint.direction > 0 else "-"
        rows.append((name, joint.servo_id, sign, f"{joint.zero_ticks:g}", travel))
    header = ("joint", "id", "direction", "zero_ticks", "moved by hand")
    print_table("found", header, rows, on_stderr=True)


def _ends(joint: JointConfig, sweep: Sweep) -> list[float]:
    """Joint values (rad, m) at the ends of the sweep; none without one."""
    if not sweep:
        return []
    travel = sweep[joint.servo_id]
    return sorted(joint.to_si(ticks) for ticks in (travel.low, travel.high))


def _read_back(config: ServoConfig) -> dict[str, float]:
    """Joint values now, as the driver will read them."""
    with closing(config.open_bus()) as bus:
        states = bus.read(list(config.ids.values()))
    return {n: j.to_si(states[j.servo_id].position_ticks) for n, j in config.joints.items()}


def _by_hand(joint: JointConfig, value: float) -> str:
    from longarm_comp.devices.servo_setup import shown

    return shown(joint, value)
