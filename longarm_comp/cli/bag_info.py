"""``longarm bag info``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_table


@click.command()
@click.argument("bag", type=click.Path(path_type=Path), metavar="BAG")
@options.as_json
def command(bag: Path, as_json: bool) -> None:
    """Topics, types and counts of a BAG folder (mcap or sqlite3).

    \b
    Example:
      longarm bag info session_bag
    """
    from longarm_comp.sessions.bag_info import bag_info

    info = bag_info(bag)
    if as_json:
        print_json(dataclasses.asdict(info))
        return
    title = f"{info.path}: {info.storage}, {info.duration_s:.1f} s, {info.messages} messages"
    rows = [(t.topic, t.type, t.count, "yes" if t.read else "") for t in info.topics]
    print_table(title, ("topic", "type", "messages", "read for a session"), rows)
