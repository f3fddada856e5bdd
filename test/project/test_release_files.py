"""One version in one place, and changelogs as the release tools of catkin and bloom read them."""

import re
import shutil
import sys
from pathlib import Path

import pytest
from places import ROOT

tools = pytest.importorskip("catkin_pkg.changelog", reason="catkin_pkg: run make setup")

from catkin_pkg.package import parse_package

sys.path.append(str(ROOT / "docs" / "made_by"))

import release

import longarm_comp

PACKAGES = [ROOT, ROOT / "longarm_interfaces"]


def test_every_file_says_the_version_and_what_it_brings() -> None:
    stale = [path.name for path, text in release.files().items() if path.read_text("utf-8") != text]
    assert not stale, "run `make release`"


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda path: path.name)
def test_release_tools_find_what_is_released(folder: Path) -> None:
    package = parse_package(str(folder / "package.xml"))
    read = tools.get_changelog_from_path(str(folder), package.name)
    newest = next(iter(read.foreach_version()))
    assert newest[0] == package.version == longarm_comp.__version__
    assert newest[1] is not None and newest[2]
    assert "`_" not in (folder / "CHANGELOG.rst").read_text("utf-8")


def test_the_next_version_is_written_everywhere(tmp_path: Path) -> None:
    names = [path.relative_to(ROOT) for path in release.files()]
    for name in (*names, Path(release.VERSION), Path(release.CHANGES)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    changes, version = tmp_path / release.CHANGES, tmp_path / release.VERSION
    version.write_text(version.read_text().replace(longarm_comp.__version__, "7.8.9"))
    with pytest.raises(SystemExit, match=r"says 7\.8\.9, CHANGELOG\.md released"):
        release.files(tmp_path)
    text = changes.read_text("utf-8")
    brings = "\n- [Drawn](docs/x.md) by `code`,\n  in two lines.\n"
    head = "## [Unreleased]\n"
    changes.write_text(text.replace(head, f"{head}\n## [7.8.9] - 2031-02-03\n### Added{brings}", 1))
    made = {path.relative_to(tmp_path): said for path, said in release.files(tmp_path).items()}
    assert all("7.8.9" in said for said in made.values())
    assert "date-released: 2031-02-03" in made[Path("CITATION.cff")]
    assert "* Drawn by ``code``,\n  in two lines.\n" in made[Path("CHANGELOG.rst")]
    changes.write_text(changes.read_text("utf-8").replace("2031-02-03", "soon"))
    with pytest.raises(SystemExit, match="soon"):
        release.files(tmp_path)


def test_the_changelog_keeps_its_form() -> None:
    """Keep a Changelog: newest first, what is not released on top, a link for each version."""
    text = (ROOT / release.CHANGES).read_text("utf-8")
    (top, *released) = release.versions(text)
    assert not top.name and released[0].items
    dates = [version.date for version in released]
    assert dates == sorted(dates, reverse=True)
    kinds = set(re.findall(r"^### (.*)", text, re.M))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
