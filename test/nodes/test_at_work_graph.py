"""`kinematics` learns at work on a real graph: play grows while targets are served."""

import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from at_work_arm import JOINT, NOISE, fitted, true_tip
from nodes_bench import Bench, facts_of, last_status
from quick_arm import quick_arm
from small_arm import ARM
from std_srvs.srv import SetBool, Trigger
from target_requests import pose

from longarm_comp.core.arm.context import LEGS, Context
from longarm_comp.core.at_work import LEARNED_SAID
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.sessions.day import read_day
from longarm_interfaces.srv import Compensate

GROWTH = 2e-3


class WornArm:
    """Where the true tip is, and what is seen of it.

    Attributes:
        more: half play that has grown, rad.
        wrong: how far the marker that is seen is beside the tip, m.
        stands: joints (n,) where it stands, and the true tip there (3,) m.
    """

    def __init__(self) -> None:
        self.more, self.wrong, self.noise = 0.0, 0.0, np.random.default_rng(2)
        self.stands, self.true = ARM.mid, np.zeros(3)

    def seen(self, q: np.ndarray, side: np.ndarray) -> np.ndarray:
        self.true = true_tip(q[None], side[None], self.more)[0]
        self.stands = q
        return np.asarray(self.true + NOISE * self.noise.standard_normal(3) + [0, self.wrong, 0])


class Work:
    """Targets, one after another, and what `kinematics` says of them."""

    def __init__(self, stage: Bench, arm: WornArm) -> None:
        self.stage, self.arm = stage, arm
        self.rng = np.random.default_rng(5)
        self.ask = graph.COMPENSATE.client(stage.node)
        self.diagnostics = stage.collect(graph.DIAGNOSTICS)

    def said(self) -> tuple[str, dict[str, str]]:
        """The last report on what was learned: message and facts."""
        status = last_status(self.diagnostics, f"/kinematics: {LEARNED_SAID}")
        return "" if status is None else status.message, facts_of(status)

    def monitored(self) -> int:
        """Number of rests in the test for drift, by the last report."""
        return int(facts_of(last_status(self.diagnostics, "/kinematics: monitor"))["rest poses"])

    def serve(self) -> float:
        """Serve a target until its sighting is learned; by how much the true tip misses it, m."""
        before = int(self.said()[1].get("sightings", 0))
        miss = self.reach()
        self.stage.spin(lambda: int(self.said()[1].get("sightings", 0)) > before)
        return miss

    def reach(self) -> float:
        """Serve a target; by how much the true tip misses it, m."""
        q = ARM.lower + (0.1 + 0.8 * self.rng.random(ARM.n)) * (ARM.upper - ARM.lower)
        target = fitted().tip(q)

        def sent() -> bool:
            request = Compensate.Request(target=pose(target), position_only=True, execute=True)
            answer = self.stage.call(self.ask, request)
            assert answer.success or answer.status in (
                Compensate.Response.NOT_READY, Compensate.Response.NO_DRIVER,
                Compensate.Response.STALE_TARGET,
            ), answer.message  # fmt: skip
            self.answer = answer
            return bool(answer.success)

        self.stage.spin(sent)
        end = np.array(self.answer.command.position)
        self.stage.spin(lambda: np.array_equal(self.arm.stands, end))
        return float(np.linalg.norm(self.arm.true - target))


def started(stage: Bench, folder: Path, namespace: str = "") -> subprocess.Popen[str]:
    arm = folder / "arm.yaml"
    if not arm.exists():
        arm.write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_none=True)))
        save_model(folder / "model.yaml", store(fitted()))
    return stage.start(
        "kinematics",
        {
            "arm": arm, "model": folder / "model.yaml", "learning": True,
            "acknowledged": True, "diagnostics_period_s": 0.2, "method": "deflection",
            "monitor.settle_s": 0.1, "monitor.sightings": 1,
        },
        namespace,
    )  # fmt: skip


@contextmanager
def recorded(bag: Path) -> Iterator[None]:
    """`longarm record` beside what is done."""
    words = [sys.executable, "-m", "longarm_comp", "record", "-o", str(bag)]
    with subprocess.Popen(words) as process:
        try:
            yield
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(300.0) == 0


def test_play_that_grows_at_work_is_named_and_compensated_without_a_stop(
    stage: Bench, tmp_path: Path
) -> None:
    arm = WornArm()
    bag = tmp_path / "bag"
    with quick_arm(ARM, lambda q: True, arm.seen), recorded(bag):
        started(stage, tmp_path)
        work = Work(stage, arm)
        files = stage.collect(graph.LEARNED)
        for _ in range(4):
            calm = work.serve()
        assert files[-1].data == str(tmp_path / "model.at_work.json")
        others = ModelFiles(str(tmp_path / "arm.yaml"), str(tmp_path / "model.yaml"))
        assert calm < 1e-4
        assert "nothing changed" in work.said()[0]
        other = started(stage, tmp_path, "other")  # would learn into the same file
        assert other.wait(300.0) == 2
        assert "model.at_work.json: file: 'in use by another process'" in stage.output(other)

        arm.more = GROWTH
        missed: list[float] = []
        while f"joint {JOINT}" not in work.said()[0]:
            missed.append(work.serve())
            assert len(missed) <= 15, work.said()
        assert max(missed) > 5e-4  # it was there
        assert np.mean([work.serve() for _ in range(5)]) < 1e-4
        assert work.monitored() + 4 <= int(work.said()[1]["sightings"])  # anew with the change
        others.follow_learned(files[-1].data)  # as the nodes do that plan paths
        q, side = ARM.mid, np.ones(ARM.n)
        legs = np.zeros((ARM.n, LEGS))
        legs[:, 0] = side
        came = Context(approach=tuple(side), legs=tuple(legs.ravel()))
        told = others.loaded.model.tip(q, came)
        assert np.linalg.norm(told - true_tip(q[None], side[None], GROWTH)[0]) < 1e-4
        others.follow_learned("")
        assert others.loaded.model is others.given.model and not others.refusal
        others.follow_learned(str(tmp_path / "lost.json"))
        assert "lost.json" in others.refusal

        stage.end_processes()
        started(stage, tmp_path)
        work.diagnostics.clear()
        assert np.mean([work.serve() for _ in range(3)]) < 1e-4
        assert f"joint {JOINT}" in work.said()[0]

        done = stage.call(graph.UNDO.client(stage.node, of="kinematics"), Trigger.Request())
        assert done.success, done.message
        stage.spin(lambda: work.said()[0].startswith("frozen: nothing changed"))
        stage.spin(lambda: work.monitored() <= 1)  # anew; where it rests may count again
        assert max(work.reach() for _ in range(3)) > 5e-4
        thaw = graph.FREEZE.client(stage.node, of="kinematics")
        assert stage.call(thaw, SetBool.Request(data=False)).success
        stage.spin(lambda: work.said()[0].startswith("learning"))
        for k in range(14):  # every second sighting shows another marker
            arm.wrong = 0.03 * (k % 2)
            work.serve()
            if "of the last sightings seem wrong" in work.said()[0]:
                break
        else:
            raise AssertionError(work.said())

        kept = tmp_path / "model.at_work.json"

        def in_the_way() -> bool:
            """Put a folder in the place of the file, unless that is just written."""
            kept.unlink(missing_ok=True)
            with suppress(NotADirectoryError, FileExistsError):
                (kept / "in the way").mkdir(parents=True)
            return kept.is_dir()

        stage.spin(in_the_way)
        work.serve()
        stage.spin(lambda: work.said()[0].startswith("not kept: "))
        work.reach()  # what cannot be written stops no target
        shutil.rmtree(kept)

        # `longarm undo` may bring back a model of which nothing can be learned
        files = stage.collect(graph.LEARNED)
        save_model(tmp_path / "model.yaml", store(replace(fitted(), uncertainty=None)))
        done = stage.call(graph.RELOAD.client(stage.node, of="kinematics"), Trigger.Request())
        assert done.success and "nothing is learned" in done.message
        stage.spin(lambda: work.said()[0].startswith("nothing is learned: "))
        stage.spin(lambda: files and files[-1].data == "")
        arm.wrong = 0.0
        assert max(work.reach() for _ in range(4)) > 5e-4
        said, facts = work.said()
        assert said.startswith("nothing is learned: ") and "sightings" not in facts

    day = read_day(bag, ARM, None, (LEARNED_SAID,))
    errors = day.error_mm
    assert np.nanmax(errors) > 0.5 and np.nanmin(errors) < 0.2
    assert any(f"joint {JOINT}" in notice.message for notice in day.said)
