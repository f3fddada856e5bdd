"""List of the commands: name, module in this folder, one line of help.

A name of two words is a command of a group.
"""

import importlib
import sys
from pathlib import Path
from typing import NamedTuple

import click

from longarm_comp.core.errors import JobError


class Entry(NamedTuple):
    """One command; a module with a dot in its name belongs to a checkout and is not installed."""

    name: str  # two words for a command of a group
    module: str  # of the click command, or ``module:name`` if it is not named `command`
    summary: str  # one line of help

    def load(self, folder: str = "longarm_comp.cli") -> click.Command:
        """Import the command and return it. Raises JobError if it needs a checkout."""
        module, _, name = self.module.partition(":")
        if "." in module:
            # A folder of the checkout stands beside the package and nowhere else: the folder in
            # which the program is started may hold anything
            root, beside = Path(__file__).resolve().parents[2], module.partition(".")[0]
            if not (root / beside / "__init__.py").is_file():
                raise JobError(f"{beside} can only be run from a checkout of the project")
            if str(root) not in sys.path:
                sys.path.append(str(root))
        else:
            module = f"{folder}.{module}"
        command: click.Command = getattr(importlib.import_module(module), name or "command")
        return command


COMMANDS = (
    Entry("init", "init", "Write an arm's folder: arm.yaml, servos, cameras, marker."),
    Entry("check", "init:check", "List what an arm's folder lacks or nobody has measured."),
    Entry("calibrate", "fit:calibrate", "Fit geometry and declared effects to a session."),
    Entry("train", "fit:train", "Train SSA-BP on the residual of the model."),
    Entry("compensate", "compensate", "Compute joint commands that bring the real tip to targets."),
    Entry("evaluate", "fit:evaluate", "Print errors at measured poses, as in the paper's Table I."),
    Entry("diagnose", "diagnose", "Find the effects that a model lacks, add and prove them."),
    Entry("fleet", "diagnose:fleet", "Diagnose many arms and compare them."),
    Entry("modes", "modes", "Predict how an arm rings after a move: frequencies, time to rest."),
    Entry("plan", "plan", "Plan poses to measure: grid, Sobol, optimal, or for a diagnosis."),
    Entry("import-data", "files", "Convert another program's CSV or XLSX to a session."),
    Entry("import-urdf", "files:import_urdf", "Write an arm.yaml of a URDF."),
    Entry("export-urdf", "files:export_urdf", "Write a calibrated arm as a URDF."),
    Entry("bag info", "bag:info", "List the contents of a bag and the topics of a session."),
    Entry("bag to-csv", "bag:to_csv", "Convert a bag to samples.csv."),
    Entry("find-port", "servo:find_port", "Find the serial port of the servo bus."),
    Entry("up", "up:up", "Start an arm's ROS graph, real or simulated."),
    Entry("study", "studies.commands", "Print the figures of docs/studies.md, from a checkout."),
    Entry("bench", "bench.command", "Compare the speed with other programs, from a checkout."),
    Entry("demo", "up:demo", "Run the whole loop over the ROS graph on a simulated arm."),
    Entry("view", "attend:view", "Show the running graph in the browser, with buttons to stop it."),
    Entry("status", "attend:status", "Print the state of the running arm: problems, what to do."),
    Entry("hold", "attend:hold", "Stop the running arm and keep it up."),
    Entry("stop", "attend:stop", "Cut the running arm's torque now."),
    Entry("reset", "attend:reset", "End a hold, a stop or a fault."),
    Entry("sim unplug", "attend:unplug", "Rehearse: a servo of the simulated arm does not answer."),
    Entry("sim cover", "attend:cover", "Rehearse: a camera of the simulated arm sees nothing."),
    Entry("sim freeze", "attend:freeze", "Rehearse: a node of the simulated arm hangs."),
    Entry("collect", "collect:collect", "Drive the poses of a plan and record the session."),
    Entry("touch", "collect:touch", "Record the joints while the tip touches points."),
    Entry("verify", "loop:verify", "Measure fresh targets without and with compensation."),
    Entry("apply", "loop:apply", "Use a diagnosis on the running graph."),
    Entry("loop", "loop:loop", "Plan, collect, diagnose, apply and verify, round by round."),
    Entry("record", "bag:record", "Record an arm's topics as a rosbag2."),
    Entry("day-report", "bag:day_report", "Make a page of a recorded day: errors, what changed."),
    Entry(
        "effects", "diagnose:effects", "Print the library of effects: parameters, priors, inputs."
    ),
    Entry("servo scan", "servo:scan", "List the servos on a bus: id, model, ids used twice."),
    Entry("servo set-id", "servo:set_id", "Give the only connected servo its id."),
    Entry("servo setup", "servo_setup:setup", "Find zeros and directions of the servos."),
    Entry("stereo marker", "stereo:marker", "Write a marker or calibration board to print."),
    Entry("stereo webcams", "stereo:webcams", "List the webcams, and how to publish their images."),
    Entry("stereo calibrate", "stereo:calibrate", "Calibrate the two cameras from a board."),
    Entry("stereo hand-eye", "stereo:hand_eye", "Find where the two cameras stand."),
    Entry("undo", "loop:undo", "Restore the version of a model.yaml before the last change."),
)

GROUPS = {
    "bag": "Sessions as rosbag2.",
    "servo": "Set up the servos: ids, zeros, directions.",
    "sim": "Rehearse faults of a simulated arm.",
    "stereo": "Cameras and marker.",
}
"""One line of help for each first word of a two-word name."""
