"""The first screen of a report's page, as Chromium draws it."""

import shutil
import subprocess
import tempfile
from pathlib import Path

from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars"),
    "--virtual-time-budget=10000",
)


def chromium() -> str:
    """Path of the browser.

    Raises:
        SystemExit: none is installed.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SystemExit(f"none of {', '.join(BROWSERS)} is installed: run `sudo make system`")
    return browser


def write_first_screen(page: Path, to: Path, size: tuple[int, int] = (1200, 985)) -> None:
    """Open a page at a size (px) and write what shows as PNG.

    Raises:
        SystemExit: no browser is installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        subprocess.run(
            [chromium(), *FLAGS, f"--user-data-dir={folder}/profile", f"--screenshot={shot}",
             f"--window-size={size[0]},{size[1]}", page.resolve().as_uri()],
            check=True, capture_output=True,
        )  # fmt: skip
        Image.open(shot).convert("RGB").save(to, optimize=True)
