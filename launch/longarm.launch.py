"""One arm's graph under `ros2 launch`, on real hardware or simulated; the same as `longarm up`.

ros2 launch longarm_comp longarm.launch.py arm:=arm.yaml model:=model.yaml port:=/dev/ttyUSB0
ros2 launch longarm_comp longarm.launch.py arm:=arm.yaml sim:=true rviz:=true
"""

import atexit
import os
import shutil
import signal
import tempfile
from pathlib import Path

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
)
from launch.event_handlers import OnProcessExit, OnShutdown
from launch.events.process import ShutdownProcess, SignalProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from longarm_comp.core.errors import InputError
from longarm_comp.nodes.bringup import GUARD, BringUp
from longarm_comp.share import folder

ARGUMENTS = (
    ("arm", None, "arm.yaml: the declared arm"),
    ("model", "", "model.yaml: the calibrated model; empty: the arm as declared"),
    ("predictor", "", "predictor file; empty: physics only"),
    ("effects", "", "Python files that define further effects, executed; ':' between paths"),
    ("network", "", "Python file of the predictor's network, executed; empty: the paper's"),
    ("sim", "false", "simulated servos and cameras instead of hardware"),
    ("hidden", "", "simulation: undeclared effects, 'backlash=2.0' (mm)"),
    ("speed", "1.0", "simulation: motion so many times faster"),
    ("port", "", "serial port of the servos; empty: the file's"),
    ("bus", "", "simulation: link to make to the servo bus; empty: in a new temporary folder"),
    ("namespace", "", "of this arm, so that several share a network"),
    ("config", "", "folder of parameter files that replace the package's own"),
    ("driver", "true", "false: another program drives the arm"),
    ("paths", "false", "trajectory_compensator too, for planned paths"),
    ("shaping", "false", "moves that leave no ring"),
    ("rviz", "false", "start RViz too"),
)


def path(text):
    """A path, or None for nothing."""
    return Path(text) if text else None


def true(text):
    """Whether an argument is set."""
    return text.lower() in ("true", "1")


def end_on_bad_input(event, made):
    """Start no node again whose input is wrong. With the driver all end; the others go on without
    another node, as the driver holds the arm."""
    if event.action not in made or event.returncode != InputError.exit_code:
        return None
    if event.process_name.startswith("servo_driver"):
        return [Shutdown(reason=event.process_name)]
    text = f"{event.process_name}: bad input; it is not started again; the other nodes go on"
    only = ShutdownProcess(process_matcher=lambda action: action is event.action)
    return [LogInfo(msg=text), EmitEvent(event=only)]


def interrupt(made):
    """Send nodes a SIGINT: launch leaves that to its terminal, and there may be none."""
    mine = SignalProcess(signal_number=signal.SIGINT, process_matcher=lambda action: action in made)
    return EmitEvent(event=mine)


def nodes(context):
    """One launch_ros Node for each of the graph."""
    given = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    sim = true(given["sim"])
    scratch = Path(tempfile.mkdtemp(prefix="longarm_"))
    atexit.register(shutil.rmtree, scratch, ignore_errors=True)
    graph = BringUp(
        arm=Path(given["arm"]),
        model=path(given["model"]),
        predictor=path(given["predictor"]),
        effects=tuple(map(Path, filter(None, given["effects"].split(os.pathsep)))),
        network=path(given["network"]),
        sim=sim,
        namespace=given["namespace"],
        config=path(given["config"]),
        port=given["port"],
        speed=float(given["speed"]),
        set={"simulated_arm": {"hidden": given["hidden"]}} if sim else {},
        driver=true(given["driver"]),
        paths=true(given["paths"]),
        shaping=true(given["shaping"]),
    ).with_servos(scratch)
    bus = given["bus"] or str(scratch / "servo_bus")
    made = [
        Node(
            package="longarm_comp",
            executable=name,
            name=name,
            namespace=graph.namespace,
            arguments=graph.arguments(name),
            parameters=graph.files(name, bus, scratch),
            output="screen",
            respawn=True,
            respawn_delay=1.0,
            additional_env={GUARD: str(os.getpid())},  # they end when launch was killed
        )
        for name in graph.nodes
    ]
    if true(given["rviz"]):
        base = "/".join(filter(None, (graph.namespace.strip("/"), "base")))
        view = ["-d", str(folder("config") / "longarm.rviz"), "-f", base]
        made.append(
            Node(package="rviz2", executable="rviz2", namespace=graph.namespace, arguments=view)
        )
    ended = OnProcessExit(on_exit=lambda event, context: end_on_bad_input(event, made))
    handlers = ended, OnShutdown(on_shutdown=[interrupt(made)])
    return [*map(RegisterEventHandler, handlers), *made]


def generate_launch_description():
    """Arguments first; the nodes are made once their values are known."""
    arguments = [DeclareLaunchArgument(n, default_value=d, description=t) for n, d, t in ARGUMENTS]
    return LaunchDescription([*arguments, OpaqueFunction(function=nodes)])
