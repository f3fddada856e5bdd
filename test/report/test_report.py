"""The report as it is written: the record, and the page's words and tables."""

import base64
import copy
import dataclasses
import json
import re
import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_pages import page_of, sample, write_sample
from report_samples import VERDICTS

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.report import cards, record, words
from longarm_comp.report.detail import Input, SeenRows
from longarm_comp.report.noise_floor import floor_of

SECTIONS = [
    *("verdict", "todo", "findings", "untested", "errors", "distribution", "scene", "guilty"),
    *("candidates", "parameters", "correlation", "outliers", "detectable", "provenance"),
]


def sections(verdict: str) -> list[str]:
    """Those of a verdict's page: findings where there are some, nothing to do with bad data."""
    absent = set() if sample(verdict)[0]["findings"] else {"findings"}
    absent |= {"todo"} if verdict == "bad_data" else set()
    return [name for name in SECTIONS if name not in absent]


# The record


def test_the_schema_asks_for_every_key_that_is_written() -> None:
    schema = record.DiagnosisReport.model_json_schema(mode="serialization")
    for kind in (schema, *schema["$defs"].values()):
        assert set(kind["required"]) == set(kind["properties"])


def test_a_joint_is_said_by_the_number_that_a_mechanic_knows() -> None:
    """Rows that are fixed come before it: row 4 is the second joint."""
    rows = [{"id": 1, "type": "fixed"}, {"id": 2, "type": "revolute", "limits_deg": [-9, 9]},
            {"id": 3, "type": "fixed"},
            {"id": 4, "type": "revolute", "limits_deg": [-9, 9], "name": "luff"}]  # fmt: skip
    data = {"name": "any", "convention": "mdh_craig", "tip": {"frame": 4}, "joints": rows}
    assert Arm.parse(data, "test").names_for_people == {
        "joint 2": "joint q1", "joint 4": "luff (q2)", "row 4": "row luff", "frame 4": "frame luff"
    }  # fmt: skip
    for row in rows:
        row |= {"type": "revolute", "limits_deg": [-9, 9]}
    assert Arm.parse(data, "test").names_for_people["joint 4"] == "luff (q4)"
    report, _ = sample("named")
    report |= {"called": {"joint 4": "luff (q2)"}, "summary": "play at joint 4, joint 41"}
    report["findings"][0] |= {"where": ["joint 4"]}
    said = record.parse_report(report).for_people()
    (card, *_) = cards.cards(said)
    assert card.title == "Play, luff (q2)" and said.summary == "play at luff (q2), joint 41"


def test_only_poses_that_tell_the_names_apart_are_said_to_do_so(tmp_path: Path) -> None:
    """next_poses.csv may hold poses for another finding, or for a doubt about a function."""
    report, detail = sample("set")
    shows = "poses of next_poses.csv show that it is backlash, not friction_hysteresis"
    (split,) = detail.splits
    for name, by in (("some", split), ("none", split._replace(poses=0, reason="No pose does."))):
        write_sample(report, dataclasses.replace(detail, splits=(by,)), tmp_path / name)
        said = (tmp_path / name / "report.html").read_text("utf-8")
        assert (shows in said) == bool(by.poses)
        assert ("a look at it shows that it is backlash" in said) == (not by.poses)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_json_holds_what_was_handed_in(verdict: str, reports: Path) -> None:
    report, _ = sample(verdict)
    written = json.loads((reports / verdict / "report.json").read_text("utf-8"))
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
    reports: Path, tmp_path: Path
) -> None:
    report, detail = sample("set")
    write_sample(dict(reversed(report.items())), detail, tmp_path)
    files = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
    assert len(files) == 6
    for file in files:
        assert (tmp_path / file).read_bytes() == (reports / "set" / file).read_bytes(), file


def test_plots_of_an_earlier_report_go(tmp_path: Path) -> None:
    (tmp_path / "plots").mkdir()
    kept = ["my_distribution.svg", "place_1 copy.svg", "place_1.svg"]
    for name in ("against_q5.svg", "distribution.svg", "place_10.svg", *kept[:2]):
        (tmp_path / "plots" / name).write_text("<svg>longarm</svg>")
    (tmp_path / "plots" / "place_1.svg").write_text("<svg>mine</svg>")
    write_sample(*sample("bad_data"), tmp_path)
    assert sorted(path.name for path in (tmp_path / "plots").iterdir()) == kept
    with pytest.raises(InputError, match=r"place_1\.svg: plot: 'exists and is no plot"):
        write_sample(*sample("named"), tmp_path)
    assert (tmp_path / "plots" / "place_1.svg").read_text() == "<svg>mine</svg>"
    (tmp_path / "plots" / "place_1.svg").unlink()
    write_sample(*sample("named"), tmp_path)
    made = [path for path in (tmp_path / "plots").iterdir() if path.stem.startswith("place")]
    write_sample(*sample("bad_data"), tmp_path)
    left = sorted(path.name for path in (tmp_path / "plots").iterdir())
    assert made and left == kept[:2]  # all that it drew before is gone


# The page


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_is_whole_and_accessible(verdict: str, reports: Path) -> None:
    page = page_of(reports / verdict)
    assert not page.faults
    assert page.all("html")[0]["lang"] == "en"
    assert [s["id"] for s in page.all("section")] == sections(verdict)
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(b <= a + 1 for a, b in pairwise(levels))
    assert all(image["alt"] for image in page.all("img"))
    assert len(page.all("caption")) == len(page.all("table"))
    assert all(head["scope"] in {"row", "col"} for head in page.all("th"))
    links = {a["href"] for a in page.all("a")}
    ids = [attrs["id"] for _, attrs in page.elements if "id" in attrs]
    assert {a for a in links if "card" not in a} == {f"#{name}" for name in sections(verdict)}
    assert links <= {f"#{name}" for name in ids}
    assert len(ids) == len(set(ids))


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_refers_to_nothing_outside(verdict: str, reports: Path) -> None:
    page = page_of(reports / verdict)
    for tag, attrs in page.elements:
        assert tag not in {"link", "iframe", "object", "embed"}
        for name in ("src", "href", "srcset", "data", "action"):
            value = attrs.get(name) or "#"
            assert value.startswith(("#", "data:image/svg+xml;base64,")), (tag, value[:80])
    (policy,) = (m["content"] for m in page.all("meta") if m.get("http-equiv"))
    assert policy is not None and policy.startswith("default-src 'none'") and "http" not in policy


@pytest.mark.parametrize("verdict", VERDICTS)
def test_verdict_and_tables_tell_the_record(verdict: str, reports: Path) -> None:
    report, detail = sample(verdict)
    page = page_of(reports / verdict)
    assert report["summary"] in page.words()
    assert f"Verdict: {verdict.replace('_', ' ').capitalize()}" in page.words()
    for finding in report["findings"]:
        assert " or ".join(finding["set"]) in page.words()
    aside = (report["set_aside"] or {"rows": 0})["rows"]
    assert (f"{aside} rows were set aside" in page.words()) == bool(aside)
    held = report["held_out"]["rows"]
    assert ("each by a model that was fitted without it" in page.words()) == bool(held)
    shown = page.tables.get("errors", [])
    assert len(shown) == (len(held) + 2 if held else 0)  # head, rows, noise floor
    for line, row in zip(shown[1:], held, strict=False):
        assert [float(v) for v in line[1:]] == pytest.approx(
            [row[k] for k in row if k not in ("model", "mean_mrad")], abs=6e-4
        )
    bodies = {
        "candidates": report["candidates"],
        "outliers": report["outliers"],
        "detectable": detail.detectable.rows if detail.detectable else (),
    }
    for section, entries in bodies.items():
        body = [line for line in page.tables.get(section, []) if not is_head(line)]
        assert len(body) == len(entries), section


def is_head(line: list[str]) -> bool:
    return line[0] in {"Effect", "Row", "#"}


def test_noise_floor_is_that_of_gaussian_noise(rng: np.random.Generator) -> None:
    report, _ = sample("named")
    report = report | {"noise": {"sigma_mm": [0.3, 0.3, 0.3], "source": "repeats", "rho": 0.0}}
    floor = floor_of(record.parse_report(report))
    drawn = rng.normal(0, 0.3, (20_000, 60, 3))
    length = np.linalg.norm(drawn, axis=-1)
    found = [
        *(length.mean(), np.sqrt((length**2).mean()), np.percentile(length, 95)),
        *(np.median(length.max(axis=1)), np.abs(drawn[..., 2]).mean(), drawn.var()),
    ]
    assert floor is not None
    assert list(floor.figures.values()) == pytest.approx(found, abs=4e-3)


def test_unproven_gain_probabilities_and_doubts_are_said(reports: Path) -> None:
    assert "the gain is not proven" in page_of(reports / "unknown").words()
    assert "the gain is not proven" not in page_of(reports / "named").words()
    table = page_of(reports / "named").tables["parameters"]
    assert table[-1] == [
        "backlash",
        "100.0 %",
        "backlash 100 %",
        "servo_droop could stand for its deadband",
    ]
    assert "Structure is left" in page_of(reports / "partly").words()


@pytest.mark.parametrize("gained", [0.95, 1.1, 0.8])
def test_the_page_advises_a_model_that_is_worth_applying_and_no_other(
    gained: float, tmp_path: Path
) -> None:
    report, detail = sample("noise")
    before, *_, after = report["held_out"]["rows"]
    for name in ("mean_mm", "commanded_mean_mm"):
        after[name] = before[name]  # as of rows that hold a few gross errors
    report["written"]["believed_mm"] = (2.0, 2.0 * gained)
    write_sample(report, detail, tmp_path)
    said, worth = page_of(tmp_path).words(), gained < 0.9
    assert ("Use the new model.yaml" in said) == worth
    assert ("Keep the model in use" in said) == (not worth)
    assert bool(record.read_report(tmp_path).nothing_gained) == (not worth)


def test_candidates_come_best_first_and_are_folded(reports: Path) -> None:
    page = page_of(reports / "named")
    lines = [line for line in page.tables["candidates"] if not is_head(line)]
    scores = [float(line[2].replace("−", "-")) for line in lines if line[2] != words.DASH]
    assert lines[0][:3] == ["backlash", "joint 2", "214.6"]
    assert scores == sorted(scores, reverse=True)
    assert [line[3] for line in lines[-3:]] == ["not testable"] * 3
    assert len(lines) == 52 and {"id": "all"} in page.all("details")


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
        provenance={evil: evil},
        held_out=dataclasses.replace(detail.held_out, inputs=inputs),
    )
    write_sample(report, detail, tmp_path)
    page = page_of(tmp_path)
    text = (tmp_path / "report.html").read_text("utf-8")
    assert not page.faults
    assert "<script>alert" not in text
    assert page.words().count("<script>alert(1)</script>") >= 9
    assert not list(tmp_path.parent.glob("*.svg"))


def test_plots_beside_the_page_are_those_in_it(reports: Path) -> None:
    page = page_of(reports / "named")
    inside = {base64.b64decode((i["src"] or "").split(",")[1]) for i in page.all("img")}
    beside = {file.read_bytes() for file in (reports / "named" / "plots").iterdir()}
    assert inside == beside and len(inside) == 4
    for svg in inside:
        assert ElementTree.fromstring(svg).tag.endswith("svg")


def test_words_for_numbers() -> None:
    assert words.number(None) == "–"
    assert words.number(-2.1e-5) == "−2.100·10⁻⁵"
    assert words.number(0.0) == "0"
    assert words.odds(np.log(20)) == "20 : 1"
    assert words.odds(-np.log(20)) == "1 : 20"
    assert words.odds(np.log(1974)) == "1974 : 1"
    assert words.odds(34 * np.log(10)) == "10³⁴ : 1"
    assert words.odds(-84_010.0) == "1 : more than 10¹⁰⁰"
    assert words.number(84_010.0) == "84010"


def test_one_row_without_error_and_no_row_at_all_are_drawn(tmp_path: Path) -> None:
    report, detail = sample("noise")
    origin = np.zeros((1, 3))
    one = SeenRows(np.array([4]), origin, {"calibrated": origin}, (Input("q1", "rad", np.ones(1)),))
    row = dict.fromkeys(report["held_out"]["rows"][0], 0.0) | {"model": "calibrated"}
    report["held_out"] |= {"n": 1, "rows": [row]}
    detail = dataclasses.replace(detail, held_out=one, guilty=("q1",))
    write_sample(report, detail, tmp_path)
    assert page_of(tmp_path).tables["errors"][1] == ["calibratedafter", *["0.000"] * 8]
    empty = SeenRows(np.zeros(0, int), origin[:0], {"calibrated": origin[:0]})
    report["held_out"] = {"n": 0, "rows": [], "before_after_ci95_mm": None}
    write_sample(report, dataclasses.replace(detail, held_out=empty), tmp_path)
    assert "No held-out rows were used." in page_of(tmp_path).words()
