"""``longarm up`` and ``demo``: commands that start a graph."""

import fcntl
import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_rows, progress
from longarm_comp.cli.signals import stop_on_signals
from longarm_comp.core.errors import JobError

SHOWN = (
    *("model", "n", "mean_mm", "rms_mm", "max_mm"),
    *("mean_abs_z_mm", "true_mean_mm", "paper_mean_mm"),
)


@click.command()
@options.arm_file
@options.path_option("--model", "Calibrated model; default: the declared arm.")
@options.path_option("--predictor", "Learned residual; default: physics only.")
@options.network_file
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
@click.option("--driver/--no-driver", default=True, help="--no-driver: another program drives.")
@options.flag("--paths", "trajectory_compensator too, for planned paths.")
@options.flag("--shaping", "Shape moves so that they leave little ring (docs/ringing.md).")
@click.option("--respawn/--no-respawn", default=True, help="Restart a node that dies.")
def up(
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
      longarm up arm.yaml --no-driver
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
        alone(namespace, stop, others=not graph.driver),
        running(graph, respawn=respawn, say=note) as supervisor,
    ):
        note(f"{', '.join(graph.nodes)} are starting; Ctrl-C ends all")
        supervisor.run(stop)


@contextmanager
def alone(namespace: str, stop: threading.Event, *, others: bool = False) -> Iterator[None]:
    """Raise JobError if a graph runs already, because both would command the same arm.

    A graph on this machine is found by its lock file, which is free again when the process ends.
    A graph on another machine is found by its driver, as soon as the middleware has discovered it,
    unless the arm may be driven by `others`.
    """
    from longarm_comp.jobs.graph_client import GraphClient, count_drivers

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
        if not others:
            with GraphClient(namespace, stop, "up") as client:
                # A graph that runs is seen within it
                client.spin(1.5)
                # The middleware counts a killed driver for 20 s
                client.until(lambda: not count_drivers(client.node), 22.0, several)
        yield


@click.command()
@options.path_option("--out", "New folder for session, model, predictor and report.", True)
@options.path_option("--arm", "Another arm: arm.yaml or its folder; default: the demonstration's.")
@click.option("--poses", type=int, default=120, help="Poses to learn from.")
@click.option("--targets", type=int, default=40, help="New targets.")
@click.option("--hidden", help="Undeclared effects of the arm: 'name=mm name=mm'.")
@click.option("--speed", type=float, default=20.0, help="Speed-up of all motion.")
@click.option("--seed", type=click.IntRange(min=0), default=1)
@options.as_json
def demo(out: Path, arm: Path | None, targets: int, **given: Any) -> None:
    """Run the whole loop over the real ROS graph on a simulated arm.

    Five nodes start. The simulated arm has errors that nobody declared. It drives to fresh targets,
    first without compensation, then with the declared deflection. A session is collected into a
    bag. The diagnosis looks for the missing effects, and a network is trained on the remaining
    error. The arm drives to the same targets again with the effects found, and also with the
    network if that lowers the error at poses left out of its training. The cameras measure the
    table. The exit code is 3 if nothing improved.

    \b
    Examples:
      longarm demo --out build/demo
      longarm demo --out build/mine --arm my_arm
    """
    from longarm_comp.core.files import write_text
    from longarm_comp.jobs.demo import DemoSettings, demonstrate

    if arm is not None:
        given["arm"] = arm / "arm.yaml" if arm.is_dir() else arm
    said = {name: value for name, value in given.items() if value is not None}
    settings = DemoSettings(out, targets=targets, **said)
    with stop_on_signals() as stop, progress("demo", lines=True) as show:
        printed = demonstrate(settings, stop, show)
    write_text(out / "demo.json", outputs.json_text(printed))
    print_json(printed)
    columns = [{name: row[name] for name in SHOWN} for row in printed["rows"]]
    print_rows(f"{targets} fresh targets, 3-D errors; the paper's arm beside", columns)
    seconds = printed["seconds"]["total"]
    note(f"measured by the cameras; true_mean_mm is the simulation's own; {seconds:.0f} s")
    note(f"hidden in the arm: {settings.hidden} (mm rms at the tip)")
    note(f"diagnosis ({printed['verdict']}): {printed['diagnosis']}")
    if printed["network_refused"]:
        note(f"no network is used: {printed['network_refused']}")
    if printed["network_inputs"]:
        used = targets - printed["outside_training_data"]
        note(f"the network was used at {used} of {targets} targets; at the others physics alone")
        note("is as good, or the targets are outside its training data")
    note(f"report in {printed['files']['report']}, the loop's page in {printed['files']['loop']}")
    if not printed["improved"]:
        raise JobError("compensation did not bring the arm nearer to its targets")
