"""The browser that tests look at pages with: Debian's Chromium, or one like it."""

import os
import shutil

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
NEEDED = "LONGARM_BROWSER"
"""Set to `needed`, a test without a browser fails, as in `.ci/run`; else it is skipped."""


def browser() -> str:
    """Path of the first that is installed; else the test is skipped, or fails where it may not."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        without = pytest.fail if os.environ.get(NEEDED) == "needed" else pytest.skip
        without(f"no {', '.join(BROWSERS)} to look at pages with: `sudo make system`, then again")
    return found
