"""``longarm record``, ``bag info``, ``bag to-csv`` and ``day-report``: recordings."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import kept_if_broken_off, note, print_json, print_rows, print_table

_DAY = outputs.with_marks(b"<!doctype html>", b"A day of work")


@click.command()
@options.output(None, "Bag folder to record.", outputs.left_to_the_command)
@options.flag("--images", "Also record images and camera calibrations.")
@click.option("--duration", type=float, help="Stop after this time, s.")
@options.flag("--resume", "Add to an existing bag.")
@click.option("--segment", default=20.0, help="Length of a file, s.")
@options.namespace
@options.as_json
def record(
    output: Path, images: bool, duration: float | None, resume: bool, segment: float, namespace: str
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
    from longarm_comp.jobs import recorder
    from longarm_comp.nodes.interfaces import DIAGNOSTICS, TIP_SEEN
    from longarm_comp.sessions.bag_segments import SegmentedBag

    pictures = recorder.IMAGE_TOPICS if images else ()
    topics = (*recorder.SESSION_TOPICS, TIP_SEEN, DIAGNOSTICS, *pictures)
    begun, bagged = time.monotonic(), output / "metadata.yaml"
    kept = f"{output} keeps what was recorded; --resume adds to it"
    with (
        stop_on_signals() as stop,
        SegmentedBag(output, resume=resume) as bag,
        kept_if_broken_off(lambda: kept if bagged.is_file() else ""),
    ):
        note("recording; Ctrl-C ends it")
        counts = recorder.record(bag, topics, stop, namespace, segment, duration)
    seconds = time.monotonic() - begun
    print_json({"bag": output, "seconds": seconds, "messages": counts})
    note(f"{sum(counts.values())} messages in {seconds:.1f} s; bag in {output}")


@click.command()
@options.bag
@options.as_json
def info(bag: Path) -> None:
    """Topics, types and counts of a BAG folder (mcap or sqlite3).

    \b
    Example:
      longarm bag info session_bag
    """
    from longarm_comp.sessions.bag import bag_info

    found = bag_info(bag)
    print_json(found)
    title = "{path}: {storage}, {duration_s:.1f} s, {messages} messages".format_map(found)
    rows = [(t["topic"], t["type"], t["count"], "yes" * t["read"]) for t in found["topics"]]
    print_table(title, ("topic", "type", "messages", "read for a session"), rows)


@click.command()
@options.arm
@options.bag
@options.output("samples.csv", "Session to write.", outputs.never)
@options.namespace_of(None, "Namespace of the arm, if the bag holds several.")
@options.as_json
def to_csv(arm: options.Arm, bag: Path, output: Path, namespace: str | None) -> None:
    """Write what BAG recorded of ARM as a session in CSV.

    A row is a command and the mean of its settled sightings.

    \b
    Example:
      longarm bag to-csv arm.yaml session_bag -o samples.csv
    """
    from longarm_comp.sessions.bag import read_bag
    from longarm_comp.sessions.csv import write_csv

    session = read_bag(bag, arm, namespace)
    write_csv(session, output)
    seen = int(session.seen.sum())
    print_json({"output": output, "rows": len(session), "seen": seen, "hash": session.hash})
    note(f"{len(session)} rows, {seen} with a marker, in {output}")


@click.command()
@options.arm
@options.bag
@options.output("day.html", "Page to write.", _DAY)
@options.namespace_of(None, "Namespace of the arm, if the bag holds several.")
@options.as_json
def day_report(arm: options.Arm, bag: Path, output: Path, namespace: str | None) -> None:
    """Make a page of a recorded day: errors by the hour, what was learned, what was refused.

    `longarm record` makes the bag while the arm works.

    \b
    Example:
      longarm day-report my_arm/arm.yaml bag_today -o today.html
    """
    from longarm_comp.core.at_work import LEARNED_SAID
    from longarm_comp.core.files import write_text
    from longarm_comp.report.pages import day_page
    from longarm_comp.sessions.day import read_day

    day = read_day(bag, arm, namespace, (LEARNED_SAID,))
    write_text(output, day_page(arm.name, bag.name, day))
    rows, said = day.by_hour(), [vars(s) for s in day.said]
    print_json({"page": output, "rows": rows, "refused": day.refused, "said": said})
    print_rows(f"{arm.name}: {day.hours:.1f} h", rows)
    note(f"page in {output}")
