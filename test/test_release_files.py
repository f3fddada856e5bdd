"""Changelogs as the release tools of catkin and bloom read them (REP 132)."""

from __future__ import annotations

from pathlib import Path

import pytest

release = pytest.importorskip("catkin_pkg.package_version", reason="catkin_pkg: run make setup")

from catkin_pkg.package import parse_package

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("folder", [ROOT, ROOT / "longarm_interfaces"], ids=lambda path: path.name)
def test_release_tools_find_what_is_to_be_released(folder: Path) -> None:
    package = parse_package(str(folder / "package.xml"))
    text = (folder / "CHANGELOG.rst").read_text("utf-8")
    assert f"Changelog for package {package.name}\n" in text
    assert release.get_forthcoming_label(text) == "Forthcoming"
