"""Finds the installed files of a package: in ``share/<package>`` of the prefix that holds it."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from longarm_comp.core.errors import InputError

PACKAGE = "longarm_comp"
_SOURCES = Path(__file__).resolve().parents[1]
"""The folder that holds this package: of a checkout, or ``site-packages``."""


def folder(name: str) -> Path:
    """Return the folder ``config`` or ``launch``: of this package's checkout, else installed."""
    places = [*_in_checkout(name), *_installed_files(PACKAGE, name)]
    for place in places:
        if place.is_dir():
            return place
    raise InputError("installation", name, "missing", " or ".join(map(str, places)))


def interface_folders(package: str, kind: str) -> list[Path]:
    """Return folders that may hold a package's ``msg`` or ``srv`` files: installed ones first."""
    return [*_installed_files(package, kind), *_in_checkout(package, kind)]


def _installed_files(package: str, name: str) -> list[Path]:
    return [prefix / "share" / package / name for prefix in dict.fromkeys(_prefixes())]


def _in_checkout(*names: str) -> list[Path]:
    return [_SOURCES.joinpath(*names)] if (_SOURCES / "package.xml").is_file() else []


def _prefixes() -> Iterator[Path]:
    """Yield this package's own prefix, then those of sourced workspaces (ament) and of Python."""
    yield from _prefix_of(_SOURCES)
    yield from map(Path, filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)))
    for entry in sys.path:
        yield from _prefix_of(Path(entry))
    yield Path(sys.prefix)


def _prefix_of(packages: Path) -> Iterator[Path]:
    """Yield the prefix of ``prefix/lib/pythonX.Y/site-packages``; nothing for any other folder."""
    if packages.name in ("site-packages", "dist-packages") and len(packages.parents) > 2:
        yield packages.parents[2]
