"""The folder of a diagnosis: one diagnosis at a time, and none is lost to data that are refused."""

from pathlib import Path
from typing import Any

import pytest
from report_pages import sample, write_sample
from small_arm import ARM

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.report.pages import write_report
from longarm_comp.report.record import parse_report, read_report
from longarm_comp.workflows.apply import read_addition
from longarm_comp.workflows.diagnose import diagnose_files


def test_two_diagnoses_into_one_folder_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They would leave the report of one beside the model of the other."""
    session, folder = tmp_path / "samples.csv", tmp_path / "diagnosis"
    session.write_text("")

    def meanwhile(*given: Any, **named: Any) -> None:
        with pytest.raises(InputError, match="in use by another process"):
            diagnose_files(ARM, session, folder)
        raise JobError("a fit diverged")

    monkeypatch.setattr("longarm_comp.workflows.diagnose.diagnose", meanwhile)
    for _ in range(2):  # whatever ends the first one, another may follow
        with pytest.raises(JobError, match="diverged"):
            diagnose_files(ARM, session, folder)
    assert not list(folder.iterdir())


def test_refused_data_leave_an_earlier_diagnosis_as_it_is(tmp_path: Path) -> None:
    bad, folder, notes = tmp_path / "bad.csv", tmp_path / "diagnosis", list[str]()
    bad.write_text("q1,q2,q3,q4,x,y,z\n0,0,0,0,1,1,1\n")

    def refuse() -> None:
        with pytest.raises(InputError, match="at least 20 distinct poses"):
            diagnose_files(ARM, bad, folder, note=notes.append)

    def held() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    refuse()
    assert read_report(folder).verdict == "bad_data"
    first = held()
    (folder / "report.html").write_text("old")
    refuse()  # a refusal takes the place of a refusal
    assert held() == first

    for write in (
        lambda: write_sample(*sample("named"), folder),
        lambda: (folder / "report.json").write_text("of a later version"),
    ):
        write()
        (folder / "model.yaml").write_text("good")
        before = held()
        refuse()
        assert held() == before
        assert notes.pop() == f"{folder} keeps the diagnosis of before"


def test_a_diagnosis_that_is_broken_off_leaves_no_report_beside_another_model(
    tmp_path: Path,
) -> None:
    report, detail = sample("named")
    write_sample(report, detail, tmp_path)

    def breaks_off() -> None:
        raise JobError("the disk is full")

    with pytest.raises(JobError, match="full"):
        write_report(parse_report(report), detail, tmp_path, breaks_off)
    with pytest.raises(InputError, match=r"report\.json"):
        read_addition(tmp_path)
    write_sample(report, detail, tmp_path)
    assert read_addition(tmp_path).verdict == "named"
