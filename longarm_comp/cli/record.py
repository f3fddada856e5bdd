"""``longarm record``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json


@click.command()
@options.output(None, "Bag folder to record.", outputs.left_to_the_command)
@click.option("--images", is_flag=True, help="Also record images and camera calibrations.")
@click.option("--duration", type=float, help="Stop after this time, s.")
@click.option("--resume", is_flag=True, help="Add to an existing bag.")
@click.option("--segment", default=20.0, show_default=True, help="Length of a file, s.")
@options.namespace
@options.as_json
def command(
    output: Path,
    images: bool,
    duration: float | None,
    resume: bool,
    segment: float,
    namespace: str,
    as_json: bool,
) -> None:
    """Record an arm's topics as a rosbag2 (mcap), until Ctrl-C.

    The bag is readable at any time. If the recorder is killed, at most the last segment is lost.

    \b
    Examples:
      longarm record -o session_1
      longarm record -o session_1 --images --duration 60
    """
    import time

    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.recorder import IMAGE_TOPICS, SESSION_TOPICS, record
    from longarm_comp.sessions.bag_segments import SegmentedBag

    topics = SESSION_TOPICS + (IMAGE_TOPICS if images else ())
    begun = time.monotonic()
    with stop_on_signals() as stop, SegmentedBag(output, resume=resume) as bag:
        note("recording; Ctrl-C ends it")
        counts = record(bag, topics, stop, namespace, segment, duration)
    seconds = time.monotonic() - begun
    if as_json:
        print_json({"bag": str(output), "seconds": seconds, "messages": counts})
        return
    note(f"{sum(counts.values())} messages in {seconds:.1f} s; bag in {output}")
