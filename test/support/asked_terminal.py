"""Somebody at a terminal who answers the questions of a program."""

import contextlib
import os
import pty
import select
import subprocess
import sys
import time
from collections.abc import Sequence

PATIENCE_S = 180.0


def at_terminal(words: Sequence[object], question: bytes, answer: bytes) -> tuple[int, int, bytes]:
    """Run Python with these words, and answer the question as often as it is read.

    The program is ended if it takes longer than `PATIENCE_S`.

    Returns:
        The exit status, the number of answers, and all that was shown.
    """
    screen, terminal = pty.openpty()
    given = [sys.executable, *map(str, words)]
    shown, answers, end = b"", 0, time.monotonic() + PATIENCE_S
    with subprocess.Popen(given, stdin=terminal, stdout=terminal, stderr=terminal) as program:
        os.close(terminal)
        with contextlib.suppress(OSError):  # the end of a terminal
            while time.monotonic() < end:
                if select.select([screen], [], [], 1.0)[0]:
                    shown += os.read(screen, 4096)
                if shown.count(question) > answers:
                    answers += 1
                    os.write(screen, answer + b"\n")
            program.kill()
    os.close(screen)
    return program.returncode, answers, shown
