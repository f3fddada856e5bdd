"""`make release`: the version and what it brings, written wherever other tools look for them.

The version stands in longarm_comp/version.py and what changed in CHANGELOG.md, in the form of Keep
a Changelog; from these two come the manifests of ROS, the citation and the changelogs of catkin.
"""

import re
import sys
from dataclasses import dataclass
from pathlib import Path

from longarm_comp.core.files import write_text

ROOT = Path(__file__).resolve().parents[2]
VERSION, CHANGES = "longarm_comp/version.py", "CHANGELOG.md"
WRITTEN = {
    "package.xml": r"(?<=<version>)[^<]+",
    "longarm_interfaces/package.xml": r"(?<=<version>)[^<]+",
    "longarm_interfaces/pyproject.toml": r'(?<=^version = ")[^"]+',
    "CITATION.cff": r"(?<=^version: )\S+",
}
"""Where the version stands, too: the pattern that it replaces."""


@dataclass(frozen=True)
class Version:
    """A version of the changelog.

    Attributes:
        name: as `1.2.0`; "" is not released.
        date: of its release, as `2026-01-31`.
        items: what it brings, in Markdown.
    """

    name: str
    date: str
    items: tuple[str, ...]


def versions(changes: str) -> list[Version]:
    """Versions of a changelog, newest first.

    Raises:
        SystemExit: a heading is neither `[Unreleased]` nor `[1.2.3] - YYYY-MM-DD`.
    """
    made = []
    for heading, body in re.findall(r"^## (.*)\n((?:(?!## ).*\n)*)", changes, re.M):
        said = re.fullmatch(r"\[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)|\[Unreleased\]", heading)
        if said is None:
            raise SystemExit(f"{CHANGES}: {heading!r}; allowed: [Unreleased], [1.2.3] - YYYY-MM-DD")
        items = re.findall(r"^- (.*\n(?:  .*\n)*)", body, re.M)
        made.append(Version(said[1] or "", said[2] or "", tuple(map(str.rstrip, items))))
    return made


def catkin(package: str, of: list[Version]) -> str:
    """CHANGELOG.rst as catkin reads it (REP 132); of the interfaces only that they belong to it."""
    title = f"Changelog for package {package}"
    line = "^" * len(title)
    text = f"{line}\n{title}\n{line}\n"
    for version in of:
        name = f"{version.name} ({version.date})" if version.name else "Forthcoming"
        items = [_plain(item) for item in version.items]
        if package != "longarm_comp":
            items = [f"As longarm_comp {version.name}."] if version.name else []
        if items:
            text += f"\n{name}\n{'-' * len(name)}\n" + "".join(f"* {item}\n" for item in items)
    return text


def _plain(item: str) -> str:
    """Markdown's links without their address, code as in reStructuredText."""
    return re.sub(r"`([^`]+)`", r"``\1``", re.sub(r"\[([^\]]+)\]\([^)]+\)", r"\1", item))


def files(root: Path = ROOT) -> dict[Path, str]:
    """What every file that says the version has to hold.

    Raises:
        SystemExit: the newest released version of the changelog is another one.
    """
    said = (root / VERSION).read_text("utf-8")
    name = said.split('"')[-2]
    of = versions((root / CHANGES).read_text("utf-8"))
    newest = next(version for version in of if version.name)
    if newest.name != name:
        raise SystemExit(f"{VERSION} says {name}, {CHANGES} released {newest.name} last")
    made = {
        root / file: re.sub(pattern, name, (root / file).read_text("utf-8"), count=1, flags=re.M)
        for file, pattern in WRITTEN.items()
    }
    cited = root / "CITATION.cff"
    made[cited] = re.sub(r"(?<=^date-released: )\S+", newest.date, made[cited], flags=re.M)
    made[root / "CHANGELOG.rst"] = catkin("longarm_comp", of)
    made[root / "longarm_interfaces" / "CHANGELOG.rst"] = catkin("longarm_interfaces", of)
    return made


def main() -> int:
    """Write what differs, and say which files; the tag to set."""
    for path, text in files().items():
        if path.read_text("utf-8") != text:
            write_text(path, text)
            print(path.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
