"""List of the commands: name, module in this folder, one line of help.

A name of two words is a command of a group.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import click


class Entry(NamedTuple):
    """One command: ``module:name`` of its click command, which is else named `command`."""

    name: str
    module: str
    summary: str

    def load(self, folder: str = "longarm_comp.cli") -> click.Command:
        """Import the command."""
        module, _, name = self.module.partition(":")
        command: click.Command = getattr(
            importlib.import_module(f"{folder}.{module}"), name or "command"
        )
        return command


COMMANDS = (
    Entry("init", "init", "Write an arm's folder: arm.yaml, servos, cameras, marker."),
    Entry("check", "check", "What an arm's folder lacks: missing, implausible, unmeasured."),
    Entry("calibrate", "calibrate", "Fit geometry and declared effects to a session."),
    Entry("train", "train", "Train SSA-BP on the residual of the model."),
    Entry("compensate", "compensate", "Joint commands that bring the real tip to targets."),
    Entry("evaluate", "evaluate", "Error table on measured poses, as in the paper's Table I."),
    Entry("diagnose", "diagnose", "Find missing effects in the residual, add and prove them."),
    Entry("fleet", "fleet", "Diagnose many arms and compare them."),
    Entry("modes", "modes", "How an arm rings after a move: frequencies, time to rest."),
    Entry("plan", "plan", "Poses to measure: grid, sobol, optimal, or those a diagnosis requests."),
    Entry("import-data", "import_data", "Convert another program's CSV or XLSX to a session."),
    Entry("import-urdf", "urdf:import_urdf", "Write an arm.yaml from a URDF."),
    Entry("export-urdf", "urdf:export_urdf", "Write a calibrated arm as a URDF."),
    Entry("bag info", "bag:info", "Contents of a bag, and the topics a session is read from."),
    Entry("bag to-csv", "bag:to_csv", "Convert a bag to samples.csv."),
    Entry("find-port", "servo:find_port", "Which serial port is the servo bus: unplug it and see."),
    Entry("up", "up", "Bring up an arm's ROS graph, real or simulated."),
    Entry("study", "study", "What prints the figures of docs/studies.md, from a checkout."),
    Entry("bench", "bench", "Speed compared with peers, in one run."),
    Entry("demo", "demo", "The whole loop over the ROS graph on a simulated arm."),
    Entry("view", "view", "A page that shows the running graph, with buttons to stop it."),
    Entry(
        "status", "attend:status", "How the running arm stands: troubles, causes, the next command."
    ),
    Entry("hold", "attend:hold", "Stop the running arm and keep it up."),
    Entry("stop", "attend:stop", "Cut the running arm's torque now."),
    Entry("reset", "attend:reset", "Go on after a hold, a stop or a fault."),
    Entry("sim unplug", "attend:unplug", "Rehearse: a servo of the simulated arm does not answer."),
    Entry("sim cover", "attend:cover", "Rehearse: a camera of the simulated arm sees nothing."),
    Entry("sim freeze", "attend:freeze", "Rehearse: a node of the simulated arm stands still."),
    Entry("collect", "collect", "Drive a pose plan over ROS and record the session."),
    Entry("touch", "touch", "Record the joints while the tip touches points: one key a touch."),
    Entry("verify", "verify", "Drive fresh targets over ROS, without and with compensation."),
    Entry("apply", "apply:apply", "Put a diagnosis to work on the running graph."),
    Entry("loop", "loop", "Plan, collect, diagnose, apply, verify: the cycle as one command."),
    Entry("record", "bag:record", "Record an arm's topics as a rosbag2."),
    Entry("day-report", "day_report", "A page of a bag of work: errors by the hour, what changed."),
    Entry("effects", "effects", "The library of effects: parameters, units, priors, inputs."),
    Entry("servo scan", "servo:scan", "The servos on a bus: id, model, firmware, ids used twice."),
    Entry("servo set-id", "servo:set_id", "Give the one servo that is connected its id."),
    Entry("servo setup", "servo_setup", "Ids, zeros and directions of the servos, by hand."),
    Entry("stereo marker", "stereo:marker", "Marker or calibration board as a page to print."),
    Entry("stereo webcams", "stereo:webcams", "The webcams, a picture of each, their ROS nodes."),
    Entry("stereo calibrate", "stereo:calibrate", "Calibrate the two cameras from a board."),
    Entry("stereo hand-eye", "stereo:hand_eye", "Find where the two cameras stand."),
    Entry("undo", "apply:undo", "Restore the version of a model.yaml before the last change."),
)

GROUPS = {
    "bag": "Sessions as rosbag2.",
    "servo": "Servo bus: what is on it, ids, zeros, directions.",
    "sim": "Faults of a simulated arm, to rehearse what one does.",
    "stereo": "Cameras and marker.",
}
"""One line of help for each first word of a two-word name."""
