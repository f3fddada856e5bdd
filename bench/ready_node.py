"""Starts a node, reports that it serves, and ends: ``ready_node MODULE --ros-args ...``."""

from __future__ import annotations

import importlib
import sys

from longarm_comp.nodes import node as process

WORD = "ready"


def main() -> None:
    """Run the node up to its first callback."""
    module = sys.argv.pop(1)
    process.spin = lambda executor, node, stop: print(WORD, flush=True)
    importlib.import_module(module).main()


if __name__ == "__main__":
    main()
