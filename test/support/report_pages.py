"""One sample diagnosis a verdict, and what the tests ask of its page."""

from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from report_samples import VERDICTS, Diagnosis

from longarm_comp.report.detail import Detail
from longarm_comp.report.pages import write_report
from longarm_comp.report.record import parse_report

SEED = 5


def sample(verdict: str) -> Diagnosis:
    """The diagnosis of a verdict, the same each time."""
    return VERDICTS[verdict](np.random.default_rng(SEED))


def write_sample(report: dict[str, Any], detail: Detail, folder: Path) -> None:
    """The report of a record that is handed in as a dict."""
    write_report(parse_report(report), detail, folder)


def write_all(folder: Path) -> None:
    """The report of every verdict, in a folder of its name."""
    for verdict in VERDICTS:
        write_sample(*sample(verdict), folder / verdict)


class Page(HTMLParser):
    """What the tests ask of a page: elements in order, tables as text, text, and open elements."""

    VOID = frozenset({"meta", "img", "input", "br", "hr", "link"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.tables: dict[str, list[list[str]]] = {}
        self.faults: list[str] = []
        self.text: list[str] = []
        self._open: list[str] = []
        self._section = ""
        self.feed(text)
        self.close()
        self.faults += [f"{tag} is never closed" for tag in self._open]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.elements.append((tag, found))
        if tag not in self.VOID:
            self._open.append(tag)
        if tag == "section":
            self._section = found["id"] or ""
        if tag == "tr":
            self.tables.setdefault(self._section, []).append([])
        if tag in {"td", "th"}:
            self.tables[self._section][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if not self._open or self._open[-1] != tag:
            self.faults.append(f"</{tag}> where {self._open[-1:]} is open")
        else:
            self._open.pop()

    def handle_data(self, data: str) -> None:
        if {"script", "style"} & set(self._open):
            return
        self.text.append(data)
        if {"td", "th"} & set(self._open):
            self.tables[self._section][-1][-1] += " ".join(data.split())

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attrs for name, attrs in self.elements if name == tag]

    def words(self) -> str:
        return " ".join(" ".join(self.text).split())


def page_of(folder: Path) -> Page:
    return Page((folder / "report.html").read_text("utf-8"))
