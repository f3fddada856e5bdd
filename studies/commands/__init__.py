"""``longarm study``: one command a file, each with a click command named `command`."""

from longarm_comp.cli.registry import Entry
from longarm_comp.cli.run import LazyGroup

STUDIES = (
    Entry("table1", "table1", "The paper's Table I on simulated arms."),
    Entry("real", "real", "Held-out errors on public data of real arms."),
    Entry("touch", "touch", "Real arms that touched sockets, places held out."),
    Entry("other-arm", "other_arm", "What a right arm says of few rows of the left."),
    Entry("fleet", "fleet", "Many simulated arms of one kind: what is found, what it takes."),
    Entry("realisable", "realisable", "Choice among the servos' steps, compared with rounding."),
    Entry("measurements", "measurements", "Rows needed by pose, position, distance, touch."),
    Entry("poses", "poses", "Which poses to measure: grid, Sobol, I-optimal."),
    Entry("coverage", "coverage", "How often a stated 90 % radius holds."),
    Entry("load", "load", "How well servo loads tell a payload, by servo."),
    Entry("conditions", "conditions", "Trained in one condition, commanded in another."),
    Entry("day", "day", "A day of work: wear, warmth, changing payloads."),
    Entry("path", "path", "Planned paths, before and after compensation."),
    Entry("readings", "readings", "What joint readings bring: names, tip, trim."),
    Entry("ringing", "ringing", "How long the tip rings, and what shaping saves."),
    Entry("discover", "discover", "Causes in no library: what finds them."),
    Entry("loop", "loop", "Benchmark the diagnosis on simulated arms."),
)
"""Name, module in this folder, one line of help."""

command = LazyGroup(
    STUDIES,
    "study",
    "Studies that print the figures of docs/studies.md, from a checkout of the project.",
    folder="studies.commands",
)
