"""Files are written whole or not at all."""

import errno
import fcntl
import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from unprivileged import unprivileged

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import alone_in, atomic_path, lock_beside, write_text


def test_text_arrives_in_a_folder_that_is_made(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folder" / "model.yaml"
    write_text(target, "Grüße\n")
    assert target.read_bytes() == "Grüße\n".encode()
    assert os.listdir(target.parent) == ["model.yaml"]


def test_a_block_that_fails_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    target = tmp_path / "model.yaml"
    write_text(target, "old")
    with pytest.raises(ZeroDivisionError), atomic_path(target) as partial:
        partial.write_text("half of the new")
        raise ZeroDivisionError
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["model.yaml"]


def test_the_old_file_stands_until_the_new_one_is_whole(tmp_path: Path) -> None:
    target = tmp_path / "model.yaml"
    write_text(target, "old")
    with atomic_path(target) as partial:
        partial.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"


def test_writers_that_go_by_the_suffix_hit_the_file(tmp_path: Path) -> None:
    target = tmp_path / "predictor.npz"
    with atomic_path(target) as partial:
        np.savez(partial, weights=np.arange(3.0))
    with np.load(target, allow_pickle=False) as held:
        assert held["weights"].tolist() == [0.0, 1.0, 2.0]


HALF = """
import sys
from longarm_comp.core.files import atomic_path
with atomic_path(sys.argv[1]) as partial:
    partial.write_text("half of the new")
    print("half", flush=True)
    sys.stdin.read()
"""


def test_what_a_killed_writer_left_goes_with_the_next_and_a_living_one_keeps_its_own(
    tmp_path: Path,
) -> None:
    target = tmp_path / "model.yaml"
    write_text(tmp_path / ".model.original.yaml", "the user's")
    writers = [
        subprocess.Popen([sys.executable, "-c", HALF, target], stdin=subprocess.PIPE,
                         stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]  # fmt: skip
    for writer in writers:
        assert writer.stdout is not None and writer.stdout.readline() == "half\n"
    killed, living = writers
    killed.kill()
    killed.wait()
    write_text(target, "whole")
    assert len(os.listdir(tmp_path)) == 3
    living.communicate("")
    assert target.read_text() == "half of the new"
    assert sorted(os.listdir(tmp_path)) == [".model.original.yaml", "model.yaml"]


def test_a_file_system_without_locks_takes_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    write_text(tmp_path / "model.yaml", "whole")
    assert (tmp_path / "model.yaml").read_text() == "whole"
    assert os.listdir(tmp_path) == ["model.yaml"]
    assert lock_beside(tmp_path / "learned.npz") is None
    with alone_in(tmp_path):
        pass


def test_permissions_are_those_of_a_plain_or_of_the_replaced_file(tmp_path: Path) -> None:
    plain, target = tmp_path / "plain", tmp_path / "target"
    plain.write_text("")
    write_text(target, "new")
    assert stat.S_IMODE(target.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)
    target.chmod(0o640)
    write_text(target, "newer")
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_a_place_that_takes_no_file_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for target in (tmp_path, tmp_path / "file" / "below.yaml", Path("/proc/none/model.yaml")):
        with pytest.raises(InputError) as caught:
            write_text(target, "text")
        assert str(target) in str(caught.value)


def test_a_read_only_folder_is_an_input_error(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with unprivileged(), pytest.raises(InputError, match="folder to write in"):
        write_text(tmp_path / "model.yaml", "text")
