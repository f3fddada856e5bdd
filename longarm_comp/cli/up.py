"""``longarm up``."""

from __future__ import annotations

import fcntl
import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note
from longarm_comp.cli.signals import stop_on_signals
from longarm_comp.core.errors import JobError


@click.command()
@options.arm_file
@options.path_option("--model", "Calibrated model; default: the declared arm.")
@options.path_option("--predictor", "Learned residual; default: physics only.")
@options.effect_files
@options.flag("--sim", "Simulated servos and cameras instead of hardware.")
@click.option("--hidden", default="", help="Simulation: undeclared effects, 'backlash=2.0' (mm).")
@click.option("--speed", default=1.0, help="Simulation: factor on all velocities.")
@click.option("--seed", default=1, help="Simulation: seed of all random choices.")
@click.option("--port", default="", help="Serial port of the servos; default: the file's.")
@options.namespace_of("", "Namespace, so that several arms share a network.")
@click.option(
    "--config",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder of parameter files NODE.yaml; default: ARM's folder, then the package's.",
)
@options.flag("--paths", "trajectory_compensator too, for planned paths.")
@options.flag("--shaping", "Shape moves so that they leave little ring (docs/ringing.md).")
@click.option("--respawn/--no-respawn", default=True, help="Restart a node that dies.")
def command(
    arm: Path,
    effect_files: tuple[Path, ...],
    sim: bool,
    hidden: str,
    seed: int,
    namespace: str,
    respawn: bool,
    **how: Any,
) -> None:
    """Start ARM's nodes as processes, until SIGINT or SIGTERM.

    This is the same graph as in the launch files, without `ros2 launch`.

    \b
    Examples:
      longarm up arm.yaml --sim
      longarm up arm.yaml --model model.yaml --predictor predictor.npz --port /dev/ttyUSB0
    """
    import rclpy  # noqa: F401

    import longarm_interfaces.msg  # noqa: F401  (missing: said here, not by five processes)
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.nodes.bringup import BringUp, running

    Arm.load(arm)
    given = {"simulated_arm": {"hidden": hidden, "seed": seed}} if sim else {}
    graph = BringUp(arm=arm, effects=effect_files, sim=sim, namespace=namespace, set=given, **how)
    with (
        stop_on_signals() as stop,
        alone(namespace, stop),
        running(graph, respawn=respawn, say=note) as supervisor,
    ):
        note(f"{', '.join(graph.nodes)} are starting; Ctrl-C ends all")
        supervisor.run(stop)


@contextmanager
def alone(namespace: str, stop: threading.Event) -> Iterator[None]:
    """Refuse a second graph beside one that runs: both would command the same arm.

    On this machine a lock tells it, which ends with its process; the graph tells of others, as
    soon as the middleware has discovered them.
    """
    from longarm_comp.jobs.graph_client import GraphClient, drivers

    several = (
        "a graph is already running in this namespace and ROS_DOMAIN_ID: end it, or use --namespace"
    )
    domain, space = os.environ.get("ROS_DOMAIN_ID", "0"), namespace.replace("/", "_")
    lock = Path(tempfile.gettempdir()) / f"longarm_up_{domain}_{space}.lock"
    with ExitStack() as held:
        with suppress(OSError):  # another user's, or no folder for it: the graph must tell
            file = held.enter_context(open(os.open(lock, os.O_RDONLY | os.O_CREAT, 0o666)))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise JobError(several) from None
        with GraphClient(namespace, stop, "up") as client:
            # A graph that runs is seen within it
            client.spin(1.5)
            # The middleware counts a killed driver for 20 s
            client.until(lambda: not drivers(client.node), 22.0, several)
        yield
