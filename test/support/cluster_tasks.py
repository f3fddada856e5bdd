"""Tasks for the workers of a cluster: each imports this file, so it imports next to nothing."""

import os
import time


def ends_its_worker(number: int) -> int:
    if number == 2:
        os._exit(1)
    time.sleep(0.05)
    return 10 * number


def process_of(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()
