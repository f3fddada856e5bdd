"""Pictures of README and pages: there, small, shown, and with the figures of today's code."""

import re
import sys
from pathlib import Path

import pytest
from places import ROOT

PICTURES = ROOT / "docs" / "pictures"
sys.path.append(str(ROOT / "docs" / "made_by"))

import pictures

SHOWN = re.compile(r"!\[(.+?)\]\((?:docs/)?pictures/([\w.]+)\)")
"""Markdown's own form, which a checkout's viewer shows too."""


def words(svg: bytes) -> list[str]:
    """Every text of a picture: matplotlib draws letters as paths and keeps them as comments."""
    return re.findall(r"<!-- (.+?) -->", svg.decode("utf-8"))


def test_every_picture_is_committed_small_and_shown_with_words_for_it() -> None:
    made = {f"{p.__name__}.svg" for p in pictures.COMPUTED}
    made |= set(pictures.OF_A_DEMONSTRATION)
    files = {file.name: file.stat().st_size for file in PICTURES.iterdir()}
    assert made <= set(files)
    limits = {".webp": 1_500_000}
    assert not {n for n, size in files.items() if size > limits.get(Path(n).suffix, 200_000)}
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    shown = [match for page in pages for match in SHOWN.findall(page.read_text("utf-8"))]
    assert {name for _, name in shown} == set(files)
    assert not [words for words, _ in shown if len(words) < 20]


@pytest.mark.parametrize("picture", pictures.COMPUTED, ids=lambda p: p.__name__)
def test_the_words_and_figures_are_those_of_todays_code(picture, tmp_path: Path) -> None:
    size = pictures.COMPUTED[picture]
    pictures.save_svg(picture, tmp_path / "drawn.svg", size)
    drawn = words((tmp_path / "drawn.svg").read_bytes())
    assert len(drawn) > 3
    assert drawn == words((PICTURES / f"{picture.__name__}.svg").read_bytes()), "make pictures"
