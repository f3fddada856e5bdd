"""The browser that tests look at pages with: Debian's Chromium, or one like it."""

from __future__ import annotations

import shutil

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def browser() -> str:
    """Path of the first that is installed."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    assert found, f"none of {', '.join(BROWSERS)} is installed: run `sudo make system`"
    return found
