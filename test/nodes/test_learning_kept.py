"""What was asked of the model at work is kept, also where its file can be written only later."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from at_work_arm import fitted

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from small_arm import ARM

from longarm_comp.core.at_work import file
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
