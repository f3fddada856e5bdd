"""The report: the record's schema, the page's words and tables, and the page in a browser."""

from __future__ import annotations

import base64
import copy
import dataclasses
import json
import re
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_samples import VERDICTS, Diagnosis, named

from longarm_comp.core.errors import InputError
from longarm_comp.report import Detail, Input, Rows, record, tables, write_report
from longarm_comp.report.arrows import MOST, arrows, exaggeration
from longarm_comp.report.figures import ladder_figure, table1_figure
from longarm_comp.report.scene import scene_json

SEED = 5
SECTIONS = [
    *("verdict", "errors", "distribution", "scene", "guilty", "candidates", "parameters"),
    *("correlation", "sets", "outliers", "detectable", "provenance"),
]


def sample(verdict: str) -> Diagnosis:
    return VERDICTS[verdict](np.random.default_rng(SEED))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Every verdict's report, written once."""
    made = {}
    for verdict in VERDICTS:
        made[verdict] = tmp_path_factory.mktemp(verdict)
        write_report(*sample(verdict), made[verdict])
    return made


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


# The record


def test_shipped_schema_is_that_of_the_record() -> None:
    shipped = Path(record.__file__).with_name("schema.json").read_text("utf-8")
    assert shipped == record.schema_text()


@pytest.mark.parametrize("verdict", VERDICTS)
def test_json_holds_what_was_handed_in(verdict: str, folders: dict[str, Path]) -> None:
    report, _ = sample(verdict)
    written = json.loads((folders[verdict] / "report.json").read_text("utf-8"))
    assert list(written) == list(report)
    assert_alike(written, report)


def assert_alike(written: Any, handed_in: Any) -> None:
    if isinstance(handed_in, dict):
        assert set(written) == set(handed_in)
        for key, value in handed_in.items():
            assert_alike(written[key], value)
    elif isinstance(handed_in, list | tuple):
        assert len(written) == len(handed_in)
        for one, other in zip(written, handed_in, strict=True):
            assert_alike(one, other)
    elif isinstance(handed_in, float):
        assert written == pytest.approx(handed_in, rel=1e-11)
    else:
        assert written == handed_in


def test_same_diagnosis_gives_same_bytes_whatever_the_order_of_keys(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    report, detail = sample("set")
    write_report(dict(reversed(report.items())), detail, tmp_path)
    files = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
    assert len(files) == 8
    for file in files:
        assert (tmp_path / file).read_bytes() == (folders["set"] / file).read_bytes(), file


BAD: list[tuple[str, tuple[str | int, ...], Any, str]] = [
    ("not a number", ("held_out", "rows", 0, "mean_mm"), float("nan"), "mean_mm"),
    ("infinite", ("findings", 0, "log_bayes_factor"), float("inf"), "log_bayes_factor"),
    ("unknown verdict", ("verdict",), "maybe", "'noise', 'named'"),
    ("unknown key", ("noise", "sigma"), 1.0, "known: rho, sigma_mm, source"),
    ("unknown key in a list", ("findings", 0, "place"), "x", "compensated, effect"),
    ("unknown model", ("held_out", "rows", 0, "model"), "best", "'nominal'"),
    ("another schema", ("schema",), "longarm/diagnosis/2", "longarm/diagnosis/1"),
    ("negative length", ("held_out", "rows", 0, "max_mm"), -1.0, "max_mm"),
    ("p above one", ("structure_left", "p_value"), 1.2, "p_value"),
]


@pytest.mark.parametrize(("path", "value", "said"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_bad_record_is_refused_and_nothing_written(
    path: tuple[str | int, ...], value: Any, said: str, tmp_path: Path
) -> None:
    report, detail = sample("named")
    report = copy.deepcopy(report)
    node: Any = report
    for step in path[:-1]:
        node = node[step]
    node[path[-1]] = value
    with pytest.raises(InputError) as caught:
        write_report(report, detail, tmp_path)
    assert said in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_missing_key_is_named(tmp_path: Path) -> None:
    report, detail = sample("named")
    del report["noise"]
    with pytest.raises(InputError, match=r"report\.json: noise: .*required"):
        write_report(report, detail, tmp_path)


def test_table_that_contradicts_the_errors_is_refused(tmp_path: Path) -> None:
    report, detail = sample("named")
    report = copy.deepcopy(report)
    report["held_out"]["rows"][3]["mean_mm"] *= 0.9
    with pytest.raises(InputError, match=r"held_out\.with_effects\.mean_mm"):
        write_report(report, detail, tmp_path)


def test_unwritable_folder_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="output folder"):
        write_report(*sample("bad_data"), tmp_path / "file")


def test_plots_of_an_earlier_report_go(tmp_path: Path) -> None:
    (tmp_path / "plots").mkdir()
    (tmp_path / "plots" / "against_q5.svg").write_text("<svg/>")
    write_report(*sample("bad_data"), tmp_path)
    assert not list((tmp_path / "plots").iterdir())


def test_detail_refuses_what_cannot_be_drawn() -> None:
    rows = named(np.random.default_rng(SEED))[1].held_out
    assert rows is not None
    with pytest.raises(InputError, match="errors_m"):
        dataclasses.replace(rows, errors_m={"calibrated": np.zeros((3, 3))})
    with pytest.raises(InputError, match="nominal, frames_only"):
        dataclasses.replace(rows, errors_m={"best": np.zeros((60, 3))})
    with pytest.raises(InputError, match="not finite"):
        dataclasses.replace(rows, measured_m=np.full((60, 3), np.nan))
    with pytest.raises(InputError, match="input q1"):
        dataclasses.replace(rows, inputs=(Input("q1", "rad", np.zeros(2)),))
    with pytest.raises(InputError, match="joint_units"):
        Detail(joints=("q1",))


def test_unknown_guilty_input_is_refused(tmp_path: Path) -> None:
    report, detail = sample("named")
    with pytest.raises(InputError, match="q9"):
        write_report(report, dataclasses.replace(detail, guilty=("q9",)), tmp_path)


# The page


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_is_whole_and_accessible(verdict: str, folders: dict[str, Path]) -> None:
    page = page_of(folders[verdict])
    assert not page.faults
    assert page.all("html")[0]["lang"] == "en"
    assert [s["id"] for s in page.all("section")] == SECTIONS
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(b <= a + 1 for a, b in pairwise(levels))
    assert all(image["alt"] for image in page.all("img"))
    assert len(page.all("caption")) == len(page.all("table"))
    assert all(head["scope"] in {"row", "col"} for head in page.all("th"))
    links = {a["href"] for a in page.all("a")}
    ids = [attrs["id"] for _, attrs in page.elements if "id" in attrs]
    assert links == {f"#{section}" for section in SECTIONS}
    assert len(ids) == len(set(ids))


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_refers_to_nothing_outside(verdict: str, folders: dict[str, Path]) -> None:
    page = page_of(folders[verdict])
    for tag, attrs in page.elements:
        assert tag not in {"link", "iframe", "object", "embed"}
        for name in ("src", "href", "srcset", "data", "action"):
            value = attrs.get(name) or "#"
            assert value.startswith(("#", "data:image/svg+xml;base64,")), (tag, value[:80])
    (policy,) = (m["content"] for m in page.all("meta") if m.get("http-equiv"))
    assert policy is not None and policy.startswith("default-src 'none'") and "http" not in policy


@pytest.mark.parametrize("verdict", VERDICTS)
def test_verdict_and_tables_tell_the_record(verdict: str, folders: dict[str, Path]) -> None:
    report, detail = sample(verdict)
    page = page_of(folders[verdict])
    assert report["summary"] in page.words()
    assert f"Verdict: {tables.VERDICTS[verdict][0]}" in page.words()
    for finding in report["findings"]:
        assert " or ".join(finding["set"]) in page.words()
    held = report["held_out"]["rows"]
    shown = page.tables.get("errors", [])
    fitted = [] if detail.train is None else ["Model", *detail.train.errors_m]
    assert len(shown) == (len(held) + 2 if held else 0) + len(fitted)  # head, rows, noise floor
    for line, row in zip(shown[1:], held, strict=False):
        assert [float(v) for v in line[1:]] == pytest.approx(
            [row[k] for k in row if k != "model"], abs=6e-4
        )
    bodies = {
        "candidates": report["candidates"],
        "outliers": report["outliers"],
        "detectable": detail.detectable,
        "sets": [pose for split in detail.splits for pose in split.poses],
    }
    for section, entries in bodies.items():
        body = [line for line in page.tables.get(section, []) if not is_head(line)]
        assert len(body) == len(entries), section


def is_head(line: list[str]) -> bool:
    return line[0] in {"Effect", "Row", "#"}


def test_noise_floor_is_that_of_gaussian_noise(rng: np.random.Generator) -> None:
    report, detail = sample("named")
    report = report | {"noise": {"sigma_mm": [0.5, 0.5, 0.5], "source": "repeats", "rho": 0.0}}
    floor = tables.error_lines(record.checked(report), detail)[-1]
    drawn = rng.normal(0, 0.5, (20_000, 60, 3))
    length = np.linalg.norm(drawn, axis=-1)
    found = [
        *(length.mean(), np.sqrt((length**2).mean()), np.percentile(length, 95)),
        *(np.median(length.max(axis=1)), np.abs(drawn[..., 2]).mean(), drawn.var(), 0.0),
    ]
    assert floor.kind == "floor"
    assert [float(value) for value in floor.values] == pytest.approx(found, abs=4e-3)


def test_unproven_gain_and_failed_checks_are_said(folders: dict[str, Path]) -> None:
    assert "the gain is not proven" in page_of(folders["unknown"]).words()
    assert "the gain is not proven" not in page_of(folders["named"]).words()
    assert "✗ no gap falls to 0.0059 rad" in page_of(folders["named"]).words()
    assert "Structure is left" in page_of(folders["partly"]).words()


def test_candidates_come_best_first_and_the_rest_is_folded(folders: dict[str, Path]) -> None:
    page = page_of(folders["named"])
    lines = [line for line in page.tables["candidates"] if not is_head(line)]
    scores = [float(line[2].replace("−", "-")) for line in lines if line[2] != tables.DASH]
    assert lines[0][:3] == ["backlash", "joint 2", "214.6"]
    assert scores == sorted(scores, reverse=True)
    assert [line[3] for line in lines[-3:]] == ["not testable"] * 3
    folded = next(k for k, (_, attrs) in enumerate(page.elements) if attrs.get("id") == "rest")
    assert sum(tag == "tr" for tag, _ in page.elements[folded:]) > 30
    assert {"id": "more"} in page.all("details")


def test_every_text_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>\"'&"
    report, detail = sample("set")
    report = copy.deepcopy(report) | {"summary": evil, "outliers": [{"index": 1, "why": evil}]}
    report["candidates"][0]["why"] = report["candidates"][0]["effect"] = evil
    report["findings"][0]["effect"] = report["findings"][0]["parameters"][0]["unit"] = evil
    report["provenance"]["data_sha256"] = evil
    assert detail.held_out is not None
    inputs = (*detail.held_out.inputs, Input(f"../{evil}", evil, np.arange(60.0)))
    detail = dataclasses.replace(
        detail,
        title=evil,
        guilty=(f"../{evil}",),
        joints=(evil, *detail.joints[1:]),
        provenance={evil: evil},
        held_out=dataclasses.replace(detail.held_out, inputs=inputs),
    )
    write_report(report, detail, tmp_path)
    page = page_of(tmp_path)
    text = (tmp_path / "report.html").read_text("utf-8")
    assert not page.faults
    assert "<script>alert" not in text
    assert page.words().count("<script>alert(1)</script>") >= 9
    assert not list(tmp_path.parent.glob("*.svg"))


def test_plots_beside_the_page_are_those_in_it(folders: dict[str, Path]) -> None:
    page = page_of(folders["named"])
    inside = {base64.b64decode((i["src"] or "").split(",")[1]) for i in page.all("img")}
    beside = {file.read_bytes() for file in (folders["named"] / "plots").iterdir()}
    assert inside == beside and len(inside) == 6
    for svg in inside:
        assert ElementTree.fromstring(svg).tag.endswith("svg")


def test_words_for_numbers() -> None:
    assert tables.number(None) == "–"
    assert tables.number(-2.1e-5) == "−2.100·10⁻⁵"
    assert tables.number(0.0) == "0"
    assert tables.odds(np.log(20)) == "20 : 1"
    assert tables.odds(-np.log(20)) == "1 : 20"
    assert tables.odds(34 * np.log(10)) == "10³⁴ : 1"
    assert tables.odds(-84_010.0) == "1 : more than 10¹⁰⁰"
    assert tables.number(84_010.0) == "84010"


def test_one_row_without_error_and_no_row_at_all_are_drawn(tmp_path: Path) -> None:
    report, detail = sample("noise")
    origin = np.zeros((1, 3))
    one = Rows(np.array([4]), origin, {"calibrated": origin}, (Input("q1", "rad", np.ones(1)),))
    row = dict.fromkeys(report["held_out"]["rows"][0], 0.0) | {"model": "calibrated"}
    report["held_out"] |= {"n": 1, "rows": [row]}
    detail = dataclasses.replace(detail, held_out=one, after="calibrated", guilty=("q1",))
    write_report(report, detail, tmp_path)
    assert page_of(tmp_path).tables["errors"][1] == ["calibratedafter", *["0.000"] * 7]
    empty = Rows(np.zeros(0, int), origin[:0], {"calibrated": origin[:0]})
    report["held_out"] = {"n": 0, "rows": [], "before_after_ci95_mm": None}
    write_report(report, dataclasses.replace(detail, held_out=empty), tmp_path)
    assert "No hold-out was opened." in page_of(tmp_path).words()


# Arrows and scene


def test_arrows_point_along_the_error(rng: np.random.Generator) -> None:
    rows = named(rng)[1].held_out
    assert rows is not None
    times = exaggeration(rows, ("calibrated",))
    found = arrows(rows, "calibrated", times)
    assert found.stop_m - found.start_m == pytest.approx(times * rows.errors_m["calibrated"])
    assert found.start_m == pytest.approx(rows.measured_m)
    assert float(f"{times:.0e}"[0]) in {1, 2, 5}


def test_few_arrows_of_many_rows(rng: np.random.Generator) -> None:
    n = 5000
    rows = Rows(np.arange(n), rng.random((n, 3)), {"nominal": 1e-3 * rng.normal(size=(n, 3))})
    found = arrows(rows, "nominal", 1.0)
    assert len(found.index) == MOST and found.index[0] == 0 and found.index[-1] == n - 1


def test_errors_of_zero_have_arrows_of_no_length() -> None:
    rows = Rows(np.arange(3), np.eye(3), {"nominal": np.zeros((3, 3))})
    assert exaggeration(rows, ("nominal",)) == 1.0
    trace = json.loads(scene_json(rows, "nominal"))["data"][0]
    assert trace["x"][:2] == [1.0, 1.0] and "NaN" not in json.dumps(trace)


def test_scene_has_every_stage_at_both_scales_and_shows_one(rng: np.random.Generator) -> None:
    rows = named(rng)[1].held_out
    assert rows is not None
    traces = json.loads(scene_json(rows, "calibrated"))["data"]
    arms = [trace for trace in traces if "meta" not in trace]
    staged = [trace for trace in traces if "meta" in trace]
    assert len(arms) == len(rows.arms_m)
    assert {(t["meta"]["stage"], t["meta"]["scale"]) for t in staged} == {
        (stage, scale) for stage in rows.errors_m for scale in ("own", "same")
    }
    assert [t["meta"]["stage"] for t in staged if t["visible"]] == ["calibrated"]
    (shown,) = (t for t in staged if t["visible"])
    ends = np.column_stack([shown[k] for k in "xyz"])[1::10].astype(float)
    times = shown["meta"]["times"]
    assert ends == pytest.approx(rows.measured_m + times * rows.errors_m["calibrated"], abs=1e-5)


# Figures of studies


def test_study_figures_are_drawn_the_same_each_time(tmp_path: Path) -> None:
    rows: Any = [
        {"row": "Original error", "mean_abs_z_mm": [15.0, 19.0, 16.0], "paper_mm": 17.7},
        {"row": "Gaussian process, 300", "mean_abs_z_mm": [2.0], "paper_mm": None},
    ]
    rungs: Any = [
        {"model": "frames_only", "mean_mm": 25.0, "rms_mm": 28.0, "max_mm": 60.0},
        {"model": "joint_compliance", "mean_mm": 4.6, "rms_mm": 5.1, "max_mm": 13.0},
    ]
    for draw, data in ((table1_figure, rows), (ladder_figure, {"justin": rungs})):
        for ending in ("png", "svg", "pdf"):
            assert len(draw(data, tmp_path / f"one.{ending}").read_bytes()) > 3000
        again = draw(data, tmp_path / "two.svg").read_bytes()
        assert again == (tmp_path / "one.svg").read_bytes()


def test_study_figures_refuse_nothing_and_not_a_number(tmp_path: Path) -> None:
    row: Any = {"row": "a", "mean_abs_z_mm": [1.0, float("nan")], "paper_mm": None}
    for rows, said in (([], "at least one row"), ([row], "finite")):
        with pytest.raises(InputError, match=said):
            table1_figure(rows, tmp_path / "a.png")
    with pytest.raises(InputError, match="one value an arm"):
        table1_figure([row | {"mean_abs_z_mm": []}], tmp_path / "a.png")
    with pytest.raises(InputError, match="rung"):
        ladder_figure({"wam": []}, tmp_path / "a.png")
    with pytest.raises(InputError, match="ending"):
        table1_figure([row | {"mean_abs_z_mm": [1.0]}], tmp_path / "a.gif")
    assert not list(tmp_path.iterdir())
