"""What stands in the blocks of a page."""

import re
import shlex
from collections.abc import Iterator

from places import ROOT

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def lines(page: str) -> Iterator[list[str]]:
    """The words of each line of a page's shell blocks, with its continuations."""
    for language, block in FENCE.findall((ROOT / page).read_text("utf-8")):
        if language in ("", "bash", "console", "sh"):
            for line in block.replace("\\\n", " ").splitlines():
                if re.match(r"(\$ )?(\S*/)?(longarm|python) ", line):
                    yield shlex.split(line.removeprefix("$ "), comments=True)
