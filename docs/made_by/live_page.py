"""The page of `longarm view` in Chromium, of a simulated arm that hides what is not declared.

python docs/made_by/live_page.py     this picture alone
"""

import re
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from geometry_msgs.msg import PoseStamped
from PIL import Image
from playwright.sync_api import Page, Playwright, sync_playwright
from screen import chromium

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import ArmClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import BringUp, running
from longarm_comp.nodes.messages import pose_message
from longarm_comp.share import folder

HIDDEN = "joint_compliance=8.0 backlash=3.0"
WIDE = (1280, 900)
_SHARES = (0.35, 0.6, 0.45)
"""Targets: where the tip goes at these shares of every joint's range."""
_LOOKS_S = 8.0
"""At each target, so that the arm comes to rest and is seen."""

_FEW_FRAMES = (
    "window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 200)"
)
"""Without a GPU 60 frames a second take all of a machine."""


def write_live_page(to: Path, size: tuple[int, int] = WIDE) -> None:
    """Bring up a simulated arm, drive it to targets, and write what its page shows as PNG."""
    path = Path(tempfile.gettempdir()) / "my_arm" / "arm.yaml"  # the page names it
    path.parent.mkdir(exist_ok=True)
    shutil.copy(folder("config") / "arm_demo.yaml", path)
    simulated = {"simulated_arm": {"hidden": HIDDEN}}
    with (
        running(BringUp(arm=path, sim=True, speed=4.0, set=simulated)),
        ArmClient(Arm.load(path), name="picture") as client,
        subprocess.Popen(
            [sys.executable, "-u", "-m", "longarm_comp", "view", "--port", "0", "--no-open"],
            stdout=subprocess.PIPE, text=True,
        ) as view,
        sync_playwright() as play,
    ):  # fmt: skip
        shot = to.with_suffix(".shot.png")
        try:
            _look(play, view, client, size, shot)
        finally:
            view.terminate()
    Image.open(shot).convert("P", palette=Image.Palette.ADAPTIVE).save(to, optimize=True)
    shot.unlink()


def _look(
    play: Playwright, view: subprocess.Popen[str], client: ArmClient, size: tuple[int, int],
    shot: Path,
) -> None:  # fmt: skip
    """Drive the arm, and write what the page shows then."""
    assert view.stdout is not None
    link = view.stdout.readline().strip()
    client.ready(120.0)
    flags = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
    browser = play.chromium.launch(executable_path=chromium(), args=flags)
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.set_default_timeout(120e3)
    page.add_init_script(_FEW_FRAMES)
    page.goto(link)
    driving = threading.Thread(target=_drive, args=(client,))
    driving.start()
    _prepare(page)
    driving.join()
    page.get_by_text(re.compile(r"tip − target: [0-9.]+ mm")).wait_for()
    page.screenshot(path=shot)
    browser.close()


def _drive(client: ArmClient) -> None:
    """To each target, and wait there."""
    model, targets = declared_model(client.arm), graph.TARGET_POSE.publisher(client.node)
    client.until(targets.get_subscription_count, 60.0, "nobody hears targets")
    for share in _SHARES:
        q = (1.0 - share) * client.arm.lower + share * client.arm.upper
        target = PoseStamped(pose=pose_message(model.pose(q)))
        target.header.frame_id = "base"
        targets.publish(target)
        client.spin(_LOOKS_S)


def _prepare(page: Page) -> None:
    """Arrows of some centimetres; not the viewer's own remark that there is no GPU here."""
    page.get_by_text("Error arrows ×").wait_for()
    factor = page.locator("input:visible").nth(1)
    factor.fill("30")
    factor.press("Enter")
    page.add_style_tag(content=".mantine-Notification-root {display: none}")


if __name__ == "__main__":
    write_live_page(Path(__file__).resolve().parents[1] / "pictures" / "view.png")
