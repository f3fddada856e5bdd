"""A bag that is readable while it is recorded, and what is left of one that was broken off."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bag_words import START_NS, offers, put_words

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.sessions.bag import bag_info, open_bag
from longarm_comp.sessions.bag_segments import SegmentedBag
from longarm_comp.sessions.message_types import publisher_quality


def test_a_growing_bag_is_readable_after_every_segment(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with SegmentedBag(path) as bag:
        for k in range(30):
            put_words(bag, "/word", f"w{k}", first=k)
            if k % 10 == 9:
                bag.finish_segment()
                with open_bag(path) as reader:
                    assert reader.message_count == k + 1
        bag.offers["/other"] = publisher_quality(1, latched=True)
        put_words(bag, "/other", "last", first=99)
    assert offers(path) == {
        "/word": (10, "reliable", "volatile"), "/other": (1, "reliable", "transient_local"),
    }  # fmt: skip
    with open_bag(path) as reader:
        stamps = [stamp for _, stamp, _ in reader.messages()]
    assert stamps == [*range(START_NS, START_NS + 30), START_NS + 99]
    with pytest.raises(InputError, match="--resume"):
        SegmentedBag(path)
    with SegmentedBag(path, resume=True) as bag:
        put_words(bag, "/word", "more", first=200)
    assert {t["topic"]: t["count"] for t in bag_info(path)["topics"]} == {"/word": 31, "/other": 1}


def test_two_recorders_of_one_bag_are_refused(tmp_path: Path) -> None:
    """The second one would remove what the first one writes, and take the place of its segments."""
    path = tmp_path / "bag"
    with SegmentedBag(path) as bag:
        put_words(bag, "/word", "one")
        for resume in (True, False):
            with pytest.raises(InputError, match=r"in use by another process|--resume"):
                SegmentedBag(path, resume=resume)
        bag.finish_segment()
    with SegmentedBag(path, resume=True) as bag:
        put_words(bag, "/word", "two", first=1)
    assert bag_info(path)["messages"] == 2


def test_a_bag_of_nothing_is_a_bag_and_rubbish_is_not_resumed(tmp_path: Path) -> None:
    with SegmentedBag(tmp_path / "empty"):
        pass
    assert bag_info(tmp_path / "empty")["messages"] == 0
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match=r"thesis\.txt"):
        SegmentedBag(tmp_path / "other", resume=True)


def test_a_recording_that_fails_before_its_first_message_leaves_nothing(tmp_path: Path) -> None:
    def fail(path: Path, *words: str, resume: bool = False) -> None:
        with SegmentedBag(path, resume=resume) as bag:
            put_words(bag, "/word", *words)
            raise JobError("no joint_states")

    for resume in (False, True):
        with pytest.raises(JobError):
            fail(tmp_path / "bag", resume=resume)
        assert not (tmp_path / "bag").exists()
    with pytest.raises(JobError):
        fail(tmp_path / "bag", "one")
    assert bag_info(tmp_path / "bag")["messages"] == 1
    with pytest.raises(JobError):
        fail(tmp_path / "bag", resume=True)
    assert bag_info(tmp_path / "bag")["messages"] == 1
    (tmp_path / "mine").mkdir()  # a folder that was there stays
    with pytest.raises(JobError):
        fail(tmp_path / "mine", resume=True)
    assert (tmp_path / "mine").exists()


def test_a_recording_that_fails_leaves_what_others_put_beside_its_metadata(tmp_path: Path) -> None:
    with SegmentedBag(tmp_path / "bag"):  # killed before its first message
        pass
    (tmp_path / "bag" / "touches.yaml").write_text("mine")
    with pytest.raises(JobError), SegmentedBag(tmp_path / "bag") as bag:
        put_words(bag, "/word", "one")
        bag.discard()
        raise JobError("nothing in it is worth going on with")
    assert [file.name for file in (tmp_path / "bag").iterdir()] == ["touches.yaml"]


def test_an_error_discards_no_bag_that_was_there_before(tmp_path: Path) -> None:
    with SegmentedBag(tmp_path / "bag") as bag:
        put_words(bag, "/word", "one")
    with pytest.raises(JobError), SegmentedBag(tmp_path / "bag", resume=True) as bag:
        put_words(bag, "/word", "two", first=1)
        bag.discard()
        raise JobError("nothing in it is worth going on with")
    assert bag_info(tmp_path / "bag")["messages"] == 2


def test_a_killed_writer_leaves_all_but_its_last_segment(tmp_path: Path) -> None:
    program = f"""
import os, signal
from bag_words import put_words
from longarm_comp.sessions.bag_segments import SegmentedBag
bag = SegmentedBag({str(tmp_path / "bag")!r}).__enter__()
for k in range(25):
    put_words(bag, "/word", "x", first=k)
    if k % 10 == 9:
        bag.finish_segment()
os.kill(os.getpid(), signal.SIGKILL)
"""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", program], env=env, check=False)
    assert done.returncode == -signal.SIGKILL
    assert bag_info(tmp_path / "bag")["messages"] == 20
    with SegmentedBag(tmp_path / "bag", resume=True) as bag:
        put_words(bag, "/word", "y", first=30)
    assert bag_info(tmp_path / "bag")["messages"] == 21
