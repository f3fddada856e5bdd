"""What a user has stays as it was until the new is whole: links, neighbours, halves of a pair."""

import json
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import openpyxl
import pytest
import yaml
from cli_shell import Shell
from diagnosis_folders import at_work, writer
from small_arm import ARM, measured

from longarm_comp.arm_folder.parameter_file import own_text
from longarm_comp.core import files
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.files import atomic_paths, write_text, write_texts
from longarm_comp.core.model.model_file import previous, read_stored
from longarm_comp.report.style import save
from longarm_comp.sessions import table
from longarm_comp.sessions.csv import write_csv
from longarm_comp.workflows.apply import apply, take_back
from longarm_comp.workflows.fleet import fleet, list_members
from longarm_comp.workflows.inputs import file_hash
from longarm_comp.workflows.model_in_use import undo


@contextmanager
def full_disk(most: int = 1000) -> Iterator[None]:
    """The system's limit of a file's size, as a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# ------------------------------------------------------------------ links


def test_a_link_stays_one_and_what_it_leads_to_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    for name, before in (("model.yaml", "old"), ("new.yaml", None)):
        real, link = tmp_path / "real" / name, tmp_path / name
        if before:
            real.write_text(before)
        link.symlink_to(Path("real") / name)
        write_text(link, "new")
        assert link.is_symlink() and real.read_text() == "new"
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(InputError, match=r"a: link: .*a link that leads to a file"):
        write_text(tmp_path / "a", "new")


def test_a_linked_model_and_predictor_are_applied_and_undone_as_files(
    work: Path, tmp_path: Path
) -> None:
    diagnosis = writer(work, tmp_path)()
    (tmp_path / "store").mkdir()
    model = at_work(tmp_path)
    model.parent.mkdir()
    model.symlink_to(tmp_path / "store" / "first.yaml")
    predictor = model.parent / "predictor.npz"
    predictor.symlink_to(tmp_path / "store" / "mine.npz")
    (tmp_path / "store" / "mine.npz").write_bytes((work / "predictor.npz").read_bytes())
    apply(diagnosis, ARM, model, network=False)
    assert model.is_symlink() and predictor.is_symlink()
    assert model.read_bytes() == (diagnosis / "model.yaml").read_bytes()
    assert previous(model).parent == tmp_path / "store"
    assert not predictor.exists()  # of another model; kept beside the file
    assert undo(model) is None
    assert model.is_symlink() and read_stored(model).version == 0
    apply(diagnosis, ARM, model, network=False)
    undo(tmp_path / "store" / "first.yaml")
    assert read_stored(model).version == 0


def test_an_apply_that_was_broken_off_after_it_is_done_again(work: Path, tmp_path: Path) -> None:
    model, diagnosis = at_work(tmp_path), writer(work, tmp_path)()
    take_back(diagnosis, model)  # nothing is at work yet
    first = apply(diagnosis, ARM, model, network=False)
    take_back(diagnosis, model)
    assert apply(diagnosis, ARM, model, network=False) == first
    assert file_hash(model) == file_hash(diagnosis / "model.yaml")
    undo(model)
    assert read_stored(model).version == 0


# ------------------------------------------------------------------ both or none


def test_files_that_belong_together(tmp_path: Path) -> None:
    a, b = tmp_path / "a.yaml", tmp_path / "b.yaml"
    write_texts({a: "1", b: "1"})
    with full_disk(), pytest.raises(JobError, match="File too large"):
        write_texts({a: "2", b: "2" * 2000})
    with pytest.raises(ZeroDivisionError), atomic_paths(a, b) as (one, _):
        one.write_text("3")
        raise ZeroDivisionError
    assert (a.read_text(), b.read_text(), len(os.listdir(tmp_path))) == ("1", "1", 2)


def test_an_import_on_a_full_disk_leaves_neither_half(shell: Shell) -> None:
    names = [f"a long name of column number {k}" for k in range(30)]
    lines = [",".join(["q1", "x [mm]", "y [mm]", "z [mm]", *names])]
    lines += [",".join(["0.1", "1", "2", "3", *["0"] * 30])] * 3
    (shell.folder / "t.csv").write_text("\n".join(lines))
    words = ("import-data", "t.csv", "--units", "rad", "-o", "s.csv")
    assert shell(*words) == 0
    session, mapping = shell.folder / "s.csv", shell.folder / "s.mapping.yaml"
    assert session.stat().st_size < 1000 < mapping.stat().st_size
    session.unlink()
    mapping.unlink()
    with full_disk():
        assert "was not written" in shell.refused(*words, code=3)
    assert sorted(os.listdir(shell.folder)) == ["t.csv"]


def test_pictures_and_pages_on_a_full_disk_are_one_line(shell: Shell) -> None:
    from matplotlib.figure import Figure

    with full_disk(100):
        said = shell.refused("stereo", "marker", "--board", "7x5", "-o", "b.pdf", code=3)
        assert "b.pdf was not written: File too large" in said
        for kind in ("png", "svg", "pdf"):
            with pytest.raises(JobError, match=rf"x\.{kind} was not written"):
                save(Figure(), shell.folder / f"x.{kind}")
    assert not os.listdir(shell.folder)


@pytest.mark.parametrize("spoiled", [b"", b"\xff\xfe\x00", b"[1, 2]\n", b"a: {ros__parameters: 1}"])
def test_hand_eye_changes_nothing_before_it_succeeds(spoiled: bytes, tmp_path: Path) -> None:
    from longarm_comp.arm_folder.measured import write_head

    (tmp_path / "stereo_bridge.yaml").write_text(own_text("stereo_bridge"))
    (tmp_path / "simulated_arm.yaml").write_bytes(spoiled)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match=r"simulated_arm\.yaml"):
        write_head(tmp_path, np.eye(4), np.eye(4), "hash", {})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    (tmp_path / "simulated_arm.yaml").write_text(own_text("simulated_arm"))
    made = write_head(tmp_path, np.eye(4), np.eye(4), "hash", {})
    assert made == ["stereo_bridge.yaml", "simulated_arm.yaml"]
    assert (tmp_path / "measured.yaml").is_file()


# ------------------------------------------------------------------ a truncated model


def test_a_model_cut_anywhere_is_refused(work: Path, tmp_path: Path) -> None:
    text = (work / "model.yaml").read_text()
    assert read_stored(work / "model.yaml").uncertainty is not None
    ends = {k for k, sign in enumerate(text) if sign == "\n"} - {len(text) - 1}
    rng = np.random.default_rng(1)
    cuts = {*sorted(ends)[-25:], *range(len(text) - 25, len(text) - 1)}
    cuts |= set(rng.integers(1, len(text), 25).tolist()) - {len(text) - 1}
    path = tmp_path / "model.yaml"
    for cut in sorted(cuts):
        path.write_text(text[:cut])
        with pytest.raises(InputError):
            read_stored(path)
    lacking = yaml.safe_load(text)
    for key in ("uncertainty", "arrivals", "placement"):
        path.write_text(yaml.safe_dump({k: v for k, v in lacking.items() if k != key}))
        with pytest.raises(InputError, match=f"{key}: 'missing'"):
            read_stored(path)


# ------------------------------------------------------------------ fleets


def _fleet(folder: Path, *names: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "arm.yaml").write_text(json.dumps(ARM.model_dump(mode="json", exclude_defaults=True)))
    for name in names:
        write_csv(measured(3, np.random.default_rng(1)), folder / name)


@pytest.mark.parametrize("name", ["...csv", "....csv", "fleet.json.csv"])
def test_a_session_whose_name_is_no_folders(name: str, tmp_path: Path) -> None:
    _fleet(tmp_path / "arms", "good.csv", name)
    with pytest.raises(InputError, match="name of an arm"):
        fleet(tmp_path / "arms", tmp_path / "out" / "in")
    assert os.listdir(tmp_path) == ["arms"]


def test_two_sessions_of_one_name(tmp_path: Path) -> None:
    _fleet(tmp_path, "a.csv")
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "metadata.yaml").write_text("")
    with pytest.raises(InputError, match=r"name of an arm: 'a'; allowed: .* no other arm's"):
        list_members(tmp_path)


def test_a_fleet_does_not_write_over_an_arm(tmp_path: Path) -> None:
    _fleet(tmp_path / "arms", "a.csv")
    _fleet(tmp_path / "a")
    with pytest.raises(InputError, match=r"a: output: 'has arm\.yaml'"):
        fleet(tmp_path / "arms", tmp_path)
    assert os.listdir(tmp_path / "a") == ["arm.yaml"]


def test_a_fleet_reads_no_pipe_and_no_endless_header(tmp_path: Path) -> None:
    _fleet(tmp_path, "a.csv")
    (tmp_path / "b.csv").write_text("x" * 131_073 + ",q1,x\n" + "1,1,1\n")
    (tmp_path / "c.csv").write_text('"q1,x\n' + "1,1\n" * 9)
    assert [member.name for member in list_members(tmp_path)] == ["a"]
    os.mkfifo(tmp_path / "d.csv")
    with pytest.raises(InputError, match=r"d\.csv: file: 'a pipe"):
        list_members(tmp_path)
    (tmp_path / "d.csv").unlink()
    (tmp_path / "a.csv").write_text("q1,q2,q3,q4,x,y,z\n0,0,0,0,0,0," + "1" * 131_073 + "\n")
    (one,) = fleet(tmp_path, tmp_path / "out")
    assert one.verdict == "failed" and "field larger than field limit" in one.summary


# ------------------------------------------------------------------ bounds of tables


def test_tables_have_bounds(tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "t.csv"
    path.write_text("q1,x,y,z\n" + "0.1,1,2,3\n" * 50)
    (tmp_path / "arm.yaml").write_text(
        json.dumps(ARM.model_dump(mode="json", exclude_defaults=True))
    )
    assert len(table.read_table(path)) == 50
    monkeypatch.setattr(table, "MOST_CELLS", 100)
    said = "cells: 'more than 100'; allowed: a smaller table"
    assert said in shell.refused("calibrate", "arm.yaml", "t.csv")
    assert said in shell.refused("import-data", "t.csv", "--units", "m,rad", "-o", "s.csv")
    monkeypatch.setattr(table, "MOST_CELLS", 10**6)
    monkeypatch.setattr(files, "MOST_BYTES", 100)
    for words in (("import-data", "t.csv", "-o", "s.csv"), ("calibrate", "arm.yaml", "t.csv")):
        assert "allowed: at most 100 bytes: split it" in shell.refused(*words)


@pytest.mark.parametrize("far", [pytest.param("XFD60000", marks=pytest.mark.long), "S60000"])
def test_a_sheet_with_a_far_cell_takes_no_memory(far: str, shell: Shell) -> None:
    import tracemalloc

    book = openpyxl.Workbook()
    sheet = book.active
    for row in (["q1", "x", "y", "z"], *[[0.1, 1, 2, 3 + k] for k in range(20)]):
        sheet.append(row)
    sheet[far] = "far"
    book.save(shell.folder / "t.xlsx")
    words = ("import-data", "t.xlsx", "--units", "m,rad", "-o", "s.csv")
    shell.refused(*words)  # everything is imported
    tracemalloc.start()
    try:
        said = shell.refused(*words)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert "t.xlsx: line 60000, q1: " in said  # it is read, and is no number
    assert peak < 20e6
