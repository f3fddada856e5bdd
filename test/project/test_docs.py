"""The documentation as pages: built without a warning, linked, offline."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from places import ROOT

import longarm_comp
from longarm_comp.core.effects.catalogue import BUILT_IN

DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built with warnings as errors; notebooks are run by `make docs`."""
    out = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(DOCS), str(out)]
    environment = os.environ | {"LONGARM_NOTEBOOKS": "off"}
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.long
def test_notebooks_run(tmp_path: Path) -> None:
    """As `make docs` builds the pages: every cell is run, an error in one ends it."""
    words = [sys.executable, "-m", "sphinx", "-q", "-W", str(DOCS), str(tmp_path)]
    done = subprocess.run(words, env=os.environ | {"LONGARM_NOTEBOOKS": "force"},
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    notebooks = sorted((DOCS / "notebooks").glob("*.md"))
    assert len(notebooks) >= 3
    for notebook in notebooks:
        page = (tmp_path / "notebooks" / notebook.with_suffix(".html").name).read_text("utf-8")
        assert "cell_output" in page, notebook.name


class Links(HTMLParser):
    """What a page loads or leads to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.leads: list[str] = []
        self.feed(page.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag in ("script", "img") and given.get("src"):
            self.loads.append(given["src"] or "")
        if tag == "link" and given.get("rel") in ("stylesheet", "icon", "preload"):
            self.loads.append(given.get("href") or "")
        if tag == "a" and given.get("href"):
            self.leads.append(given["href"] or "")


@pytest.mark.long
def test_every_page_is_there_linked_and_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    for page in pages:
        links = Links(page)
        for target in (*links.loads, *links.leads):
            path = re.sub("[?#].*", "", target)
            outside = re.match(r"[a-z]+:|//", target)
            assert not (outside and target in links.loads), f"{page.name} loads {target}"
            assert outside or not path or (page.parent / path).exists(), f"{page.name}: {target}"
    for source in DOCS.rglob("*.md"):
        assert (site / source.relative_to(DOCS)).with_suffix(".html").is_file()
    text = (site / "start.html").read_text("utf-8")
    assert 'href="your_own_arm.html"' in text and "docs/your_own_arm.md" not in text


def test_what_the_readme_and_the_pages_lead_to_is_there() -> None:
    count = 0
    for page in (DOCS.parent / "README.md", *DOCS.glob("*.md")):
        targets = re.findall(r"\]\((?!https?:|made/)([^)#]+)", page.read_text("utf-8"))
        count += len(targets)
        assert not [t for t in targets if not (page.parent / t).is_file()], page.name
    assert count > 30


@pytest.mark.long
def test_pages_of_effects_and_names_come_from_the_package(site: Path) -> None:
    for name, kind in BUILT_IN.items():
        text = (site / "made" / "effects" / f"{name}.html").read_text("utf-8")
        assert f"{kind.__name__}" in text
        assert all(p.name in text for p in kind.declared())
    api = (site / "api.html").read_text("utf-8")
    assert not [
        n for n in longarm_comp.__all__ if f"longarm_comp.{n}" not in api and n != "effects"
    ]
