"""Where installed files are looked for: the checkout, the own prefix, sourced workspaces."""

import os
from pathlib import Path

import pytest
from places import ROOT

from longarm_comp import share
from longarm_comp.core.errors import InputError


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package installed into a prefix of its own, which has no shares; no other is known."""
    folder = tmp_path / "own" / "lib" / "python3" / "site-packages"
    monkeypatch.setattr(share, "_SOURCES", folder)
    monkeypatch.setattr(share.sys, "path", [])
    monkeypatch.setattr(share.sys, "prefix", str(tmp_path / "python"))
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    return folder


def config(prefix: Path) -> Path:
    made = prefix / "share" / "longarm_comp" / "config"
    made.mkdir(parents=True)
    return made


def test_the_checkout_comes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    config(tmp_path)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    assert share.folder("config") == ROOT / "config"


def test_what_no_prefix_has_is_said(packages: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="config: 'missing'") as caught:
        share.folder("config")
    assert str(tmp_path / "python" / "share" / "longarm_comp") in str(caught.value)


def test_python_then_workspaces_then_the_own_prefix(
    packages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each added place is nearer than those before it."""
    last = config(tmp_path / "python")
    assert share.folder("config") == last
    on_path = config(tmp_path / "venv")
    monkeypatch.setattr(share.sys, "path", ["", str(tmp_path / "venv/lib/python3/dist-packages")])
    assert share.folder("config") == on_path
    sourced = config(tmp_path / "overlay")
    workspaces = (tmp_path / "empty", tmp_path / "overlay", tmp_path / "python")
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join(map(str, workspaces)))
    assert share.folder("config") == sourced
    own = config(tmp_path / "own")
    assert share.folder("config") == own


def test_interfaces_are_taken_as_they_are_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    places = share.interface_folders("longarm_interfaces", "msg")
    assert places[0] == tmp_path / "share" / "longarm_interfaces" / "msg"
    assert places[-1] == ROOT / "longarm_interfaces" / "msg"
