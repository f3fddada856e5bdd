"""The command line: a file for each command or group of commands, listed in `registry.py`.

A new command is a file with a click command named `command`, and one line in the list; its
module is imported when it is run, so that ``longarm --help`` stays quick. It passes its results to
`print_json` and to `print_rows`: with ``--json`` only the first prints, else only the second.
"""

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``longarm`` and exit with its code: 0 done, 2 bad input, 3 not possible."""
    try:
        from longarm_comp.libraries import refuse_old_libraries

        refuse_old_libraries()
        from longarm_comp.cli.run import run

        code = run(arguments)
    except KeyboardInterrupt:  # while it still loads
        print("longarm: interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)
