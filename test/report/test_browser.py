"""The report's page in a real browser: nothing asked of the network, nothing complained of.

Chromium draws a copy of the page that carries a recorder (first in the head: errors, warnings,
refused loads) and a visitor (last in the body: looks, clicks, types, and leaves JSON behind).
"""

import base64
import html
import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import browser

FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--window-size=1200,900", "--virtual-time-budget=20000"),
)
POLICY = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*>')

RECORDER = """<script>
window.faults = [];
addEventListener("error", (e) => faults.push("error: " + (e.message || e.target.outerHTML)), true);
addEventListener("unhandledrejection", (e) => faults.push("rejection: " + e.reason));
addEventListener("securitypolicyviolation", (e) => faults.push("refused: " + e.blockedURI));
for (const kind of ["error", "warn"]) console[kind] = (...said) => faults.push(said.join(" "));
</script>"""

VISITOR = """<pre id="visit"></pre><script>
const byId = (id) => document.getElementById(id);
const shows = (id) => !!byId(id) && byId(id).checkVisibility();
const all = () => [...byId("tried").tBodies[0].rows].map((r) => r.cells[0].textContent);
const folded = () => ({ rows: all().length, open: byId("all").open });
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const picture = () => byId("plot").toDataURL();
const drag = (by) => byId("plot").dispatchEvent(new PointerEvent("pointermove", by));
const type = (id, text) => {
  byId(id).value = text;
  byId(id).dispatchEvent(new Event(id === "state" ? "change" : "input"));
  return all();
};
addEventListener("load", async () => {
  const seen = {};
  try {
    const summary = document.querySelector(".verdict .figure, .verdict > .summary");
    const box = summary.getBoundingClientRect();
    seen.verdict = { text: summary.innerText, top: box.top, tall: box.height };
    seen.wide = document.documentElement.scrollWidth - innerWidth;
    seen.scene = shows("plot");
    if (byId("tried")) {
      seen.sorted = { start: folded() };
      document.querySelector("#tried th[data-key=effect] button").click();
      seen.sorted.effect = all();
      seen.sorted.says = document.querySelector("#tried th[data-key=effect]").ariaSort;
      seen.filtered = { words: type("words", "session has no TIME") };
      type("words", "");
      seen.filtered.state = type("state", "accepted");
      dispatchEvent(new Event("beforeprint"));
      seen.printed = folded();
      dispatchEvent(new Event("afterprint"));
      seen.printed.then = folded();
      seen.filtered.none = type("state", "");
    }
    if (seen.scene) {
      seen.before = await picture();
      seen.times = [byId("times").textContent];
      document.querySelector("input[value=with_effects]")?.click();
      seen.after = await picture();
      seen.times.push(byId("times").textContent);
      drag({ buttons: 1, movementX: 100, movementY: 20 });
      seen.turned = await picture();
    }
    seen.loads = performance.getEntriesByType("resource").map((entry) => entry.name);
  } catch (error) { faults.push("visitor: " + error.stack); }
  seen.faults = faults;
  byId("visit").textContent = JSON.stringify(seen);
});
</script></body>"""


Visit = Callable[..., dict[str, Any]]


@pytest.fixture
def visit(tmp_path: Path) -> Visit:
    """Open a page's text in the browser and return what the visitor saw."""

    def visited(text: str, *flags: str) -> dict[str, Any]:
        copy = tmp_path / "visited.html"
        copy.write_text(
            text.replace("<head>", "<head>" + RECORDER, 1).replace("</body>", VISITOR), "utf-8"
        )
        profile = f"--user-data-dir={tmp_path / 'profile'}"
        command = [browser(), *FLAGS, profile, *flags, "--dump-dom", copy.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        left = re.search(r'<pre id="visit">(.+?)</pre>', done.stdout, re.DOTALL)
        assert left, f"the page did not finish: {done.stderr[-2000:]}"
        seen: dict[str, Any] = json.loads(html.unescape(left[1]))
        return seen

    return visited


def page_text(folder: Path) -> str:
    return (folder / "report.html").read_text("utf-8")


def pixels_of(picture: str, rgb: tuple[int, int, int]) -> int:
    """How many pixels of a PNG data address are of about that colour."""
    content = np.frombuffer(base64.b64decode(picture.split(",")[1]), np.uint8)
    image = cv2.imdecode(content, cv2.IMREAD_COLOR)
    assert image is not None
    return int((np.abs(image[..., ::-1].astype(int) - rgb).max(axis=-1) < 40).sum())


ORANGE, BLUE, GREY = (230, 159, 0), (0, 114, 178), (138, 138, 138)


def test_full_page_shows_sorts_and_filters(visit: Visit, reports: Path) -> None:
    seen = visit(page_text(reports / "named"))
    assert seen["faults"] == []
    assert all(load.startswith(("data:", "blob:")) for load in seen["loads"])

    assert re.fullmatch(r"[\d.]+ → [\d.]+ mm", seen["verdict"]["text"])
    assert seen["verdict"]["tall"] > 10 and 0 < seen["verdict"]["top"] < 600
    assert seen["wide"] <= 0

    assert seen["scene"]
    assert pixels_of(seen["before"], GREY) > 300
    assert pixels_of(seen["before"], ORANGE) > 300 and pixels_of(seen["before"], BLUE) < 20
    assert pixels_of(seen["after"], BLUE) > 300 and pixels_of(seen["after"], ORANGE) < 20
    assert seen["turned"] != seen["after"]
    first, then = seen["times"]
    assert re.fullmatch(r"arrows × \d+", first) and then != first

    assert seen["sorted"]["start"] == {"rows": 52, "open": False}
    assert seen["sorted"]["effect"] == sorted(seen["sorted"]["effect"])
    assert seen["sorted"]["says"] == "ascending"
    assert seen["filtered"]["words"] == ["creep"]
    assert seen["filtered"]["state"] == ["backlash"]
    assert len(seen["filtered"]["none"]) == 52
    assert seen["printed"] == {"rows": 52, "open": True, "then": {"rows": 1, "open": False}}


def test_narrow_page_does_not_run_over(visit: Visit, reports: Path) -> None:
    seen = visit(page_text(reports / "set"), "--window-size=500,900")
    assert seen["faults"] == [] and seen["scene"] and seen["wide"] <= 0


def test_page_without_data_is_quiet(visit: Visit, reports: Path) -> None:
    seen = visit(page_text(reports / "bad_data"))
    assert seen["faults"] == [] and seen["loads"] == []
    assert "812 m from the base" in seen["verdict"]["text"] and not seen["scene"]


def test_the_scene_needs_no_webgl(visit: Visit, reports: Path) -> None:
    seen = visit(page_text(reports / "noise"), "--disable-3d-apis")
    assert seen["faults"] == [] and seen["scene"]


def test_a_planted_fault_is_found(visit: Visit, reports: Path) -> None:
    """The recorder works, and the page's own policy stops what it would report."""
    text = page_text(reports / "bad_data")
    planted = (
        '<img alt="" src="http://127.0.0.1:9/planted.png"><script>undefinedName();</script></main>'
    )
    text = text.replace("</main>", planted)
    held = visit(text)
    assert any("refused: http://127.0.0.1:9" in fault for fault in held["faults"])
    assert any("undefinedName" in fault for fault in held["faults"])
    let_through = visit(POLICY.sub("", text))
    assert let_through["loads"] == ["http://127.0.0.1:9/planted.png"]
