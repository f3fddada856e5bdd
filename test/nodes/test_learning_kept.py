"""What was learned at work is kept: until its file can be written, and while its model is away."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from at_work_arm import fitted

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from small_arm import ARM

from longarm_comp.core.at_work import file
from longarm_comp.core.at_work.learner import Learner
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model_file import load_model, save_model, store
from longarm_comp.nodes.learning import Learning


class Site:
    """The state of a node whose worker works at once, and the timers of the node."""

    def __init__(self, model: Path) -> None:
        self.node = MagicMock()
        self.worker = SimpleNamespace(submit_once=lambda job: job())
        save_model(model, store(fitted()))
        loaded = SimpleNamespace(model=load_model(model, ARM), file_hash="hash")
        self.files = SimpleNamespace(given=loaded, replace_model=lambda learned: None)
        self.p = {
            "learning": True,
            "learning_step_m": 2e-3,
            "learned_file": "",
            "model": str(model),
        }

    def later(self) -> None:
        for made in self.node.create_timer.call_args_list:
            made.args[1]()


def test_a_freeze_that_could_not_be_written_says_so_and_is_written_later(tmp_path: Path) -> None:
    site = Site(tmp_path / "model.yaml")
    learning = Learning(site)  # type: ignore[arg-type]
    kept = tmp_path / "model.at_work.json"
    kept.unlink()
    kept.mkdir()  # in the way, as a full disk would be
    for asked in (lambda: learning.freeze(True), learning.undo):
        done, said = asked()
        assert done
        assert "until this node ends: not kept: " in said
    site.later()
    assert kept.is_dir()
    kept.rmdir()
    site.later()
    again = file.load(kept, site.files.given.model, "hash")
    assert again.frozen
    assert learning.freeze(False) == (True, "learning")


def test_what_was_learned_with_a_model_returns_with_it(tmp_path: Path) -> None:
    site, kept = Site(tmp_path / "model.yaml"), tmp_path / "model.at_work.json"
    learning = Learning(site)  # type: ignore[arg-type]

    def learned_with(name: str) -> int:
        site.files.given.file_hash = f"{name:0<64}"
        learning.begin()
        assert learning.learner is not None
        held = file.load(kept, fitted(), f"{name:0<64}")
        assert held.sightings == learning.learner.sightings
        return held.sightings

    def learn(name: str, sightings: int) -> None:
        file.save(kept, replace(Learner.of(fitted()), sightings=sightings), f"{name:0<64}")

    assert learned_with("a") == 0
    learn("a", 7)
    assert learned_with("a") == 7
    assert learned_with("b") == 0
    assert {p.name for p in tmp_path.glob("*.of_*")} == {f"model.at_work.of_{'a':0<12}.json"}
    assert learned_with("a") == 7  # nothing was learned with b, so no file of it is kept
    assert not list(tmp_path.glob("*.of_*"))
    learn("a", 8)
    assert learned_with("b") == 0
    learn("b", 3)
    assert learned_with("a") == 8
    assert learned_with("b") == 3

    kept.unlink()  # as a process leaves it that is killed between two names
    assert learned_with("a") == 8
    kept.write_text("{")
    with pytest.raises(InputError, match=r"at_work\.json: file"):
        learning.begin()
    assert kept.read_text() == "{"


def test_what_was_learned_is_kept_beside_the_file_that_a_link_leads_to(tmp_path: Path) -> None:
    shared, link = tmp_path / "disk" / "learned.json", tmp_path / "model.at_work.json"
    link.symlink_to(shared)
    file.save(link, replace(Learner.of(fitted()), sightings=7), "a")
    file.take_up(link, "b")
    assert link.is_symlink() and not shared.exists()
    file.take_up(link, "a")
    assert file.load(link, fitted(), "a").sightings == 7


def test_a_folder_that_takes_no_other_name_leaves_the_file(tmp_path: Path) -> None:
    kept = tmp_path / "model.at_work.json"
    file.save(kept, replace(Learner.of(fitted()), sightings=7), "a")
    (tmp_path / "model.at_work.of_a.json" / "in the way").mkdir(parents=True)
    file.take_up(kept, "b")
    assert file.load(kept, fitted(), "a").sightings == 7
