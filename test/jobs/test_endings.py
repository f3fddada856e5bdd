"""Every ending of `touch` and `apply`: its cause, what is kept, the next command."""

import errno
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from threading import Event
from unittest.mock import MagicMock

import click
import pytest
from cli_shell import Shell
from places import EXAMPLES
from report_pages import sample, write_sample
from touching import ARM

from longarm_comp.core.errors import JobError
from longarm_comp.jobs import apply as apply_job
from longarm_comp.jobs import touch as touch_job

EXAMPLE = EXAMPLES / "panda_touch" / "arm.yaml"
FULL = OSError(errno.ENOSPC, "No space left on device", "file")
Keys = Callable[..., None]


class Client(nullcontext[object]):
    """Stands for one on a graph."""

    def __init__(self, arm: object, namespace: str, stop: Event, name: str) -> None:
        super().__init__(self)
        self.stop, self.putting_back = stop, nullcontext


def raising(error: BaseException) -> Callable[..., None]:
    def act(*_: object, **__: object) -> None:
        raise error

    return act


@pytest.fixture
def keys(monkeypatch: pytest.MonkeyPatch) -> Keys:
    """A graph whose arm rests, and somebody at its keys: lines, or something that happens."""
    monkeypatch.setattr("longarm_comp.jobs.client.ArmClient", Client)
    monkeypatch.setattr(touch_job, "wait_for_rest", lambda client: ARM.mid)
    monkeypatch.setattr(touch_job, "_is_seated", lambda client: True)

    def press(*lines: str | Callable[[], None]) -> None:
        left: Iterator[str | Callable[[], None]] = iter(lines)

        def line(*_: object, **__: object) -> str:
            now = next(left, None)
            if now is None:
                raise EOFError
            if callable(now):
                now()
                return ""
            return now

        monkeypatch.setattr(click.termui, "visible_prompt_func", line)

    return press


def touched(shell: Shell, *words: str) -> tuple[int, str]:
    code = shell("touch", EXAMPLE, "-o", "t.csv", *words)
    return code, shell.err


def rows() -> int:
    return len(Path("t.csv").read_text().splitlines()) - 1


def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    return lambda: monkeypatch.setattr(os, "fsync", raising(FULL))


@pytest.mark.parametrize("end", [("end",), ()], ids=["end", "end of the input"])
def test_touches_that_end(keys: Keys, end: tuple[str, ...], shell: Shell) -> None:
    keys("", "b", "", "", "undo", *end)
    code, said = touched(shell)
    assert code == 0 and rows() == 2
    assert f"2 touches in t.csv; next: longarm calibrate {EXAMPLE} t.csv" in said


def test_no_touch(keys: Keys, shell: Shell) -> None:
    keys("", "undo", "end")
    code, said = touched(shell)
    assert code == 0 and not Path("t.csv").exists() and "nothing is written" in said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_the_prompt_waits_for_no_key(
    keys: Keys, number: signal.Signals, shell: Shell
) -> None:
    keys("", "", lambda: os.kill(os.getpid(), number), "")
    code, said = touched(shell)
    assert code == 130 and rows() == 2
    assert said.splitlines()[-2:] == [
        "longarm: t.csv keeps 2 touches; --resume adds to them", "longarm: interrupted",
    ]  # fmt: skip


def test_a_full_disk_keeps_the_touches_before(
    keys: Keys, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys("", "", full_disk(monkeypatch), "end")
    code, said = touched(shell)
    assert code == 3 and rows() == 2
    *_, kept, cause = said.splitlines()
    assert "t.csv keeps 2 touches; --resume adds to them" in kept and "No space left" in cause


def test_an_arm_that_does_not_rest_is_told_and_waited_for(
    keys: Keys, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shaky() -> None:
        monkeypatch.setattr(touch_job, "wait_for_rest", raising(JobError("the arm did not rest")))

    keys("", shaky, "end")
    code, said = touched(shell)
    assert code == 0 and rows() == 1 and "the arm did not rest" in said


def test_torque_is_on_again_after_a_fault(
    keys: Keys, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    attendant = MagicMock(let_go=lambda: ("torque off", "emergency stop since now"))
    monkeypatch.setattr(touch_job, "Attendant", lambda client: attendant)
    keys("", full_disk(monkeypatch), "end")
    code, _ = touched(shell, "--by-hand")
    assert code == 3
    attendant.take_back.assert_called_once_with("emergency stop since now")


def test_torque_that_cannot_be_switched(
    keys: Keys, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    attendant = MagicMock(let_go=raising(JobError("no driver answers")))
    monkeypatch.setattr(touch_job, "Attendant", lambda client: attendant)
    keys("")
    assert touched(shell, "--by-hand") == (3, "longarm: no driver answers\n")


@pytest.mark.parametrize("begun", [False, True])
@pytest.mark.parametrize(
    ("error", "code", "cause"),
    [
        (FULL, 3, "No space left"),
        (JobError("error_predictor did not take up its file"), 3, "did not take up"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
    ids=["full disk", "refused", "interrupted"],
)
def test_apply_that_is_broken_off(
    begun: bool, error: BaseException, code: int, cause: str, shell: Shell,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Before anything is changed nothing is said of what is kept."""

    def broken(*_: object, progress: Callable[[str, float], None], **__: object) -> None:
        if begun:
            progress("network", 0.5)
        raise error

    monkeypatch.setattr("longarm_comp.jobs.graph_client.GraphClient", MagicMock())
    monkeypatch.setattr(apply_job, "apply_on_graph", broken)
    assert shell("apply", "diagnosis") == code
    *before, last = shell.err.splitlines()
    assert cause in last
    assert ("run the same command again" in " ".join(before)) == begun


def test_apply_says_how_to_take_back_a_predictor_in_another_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    model, predictor = tmp_path / "work" / "model.yaml", tmp_path / "elsewhere" / "predictor.npz"
    client, said = MagicMock(), []
    client.parameters.side_effect = [(str(EXAMPLE), str(model)), (str(predictor),)]
    done = MagicMock(undo=f"longarm undo {model}")
    monkeypatch.setattr(apply_job, "apply", lambda *_, **__: done)
    monkeypatch.setattr(apply_job, "read_addition", MagicMock())
    assert apply_job.apply_on_graph(client, tmp_path / "diagnosis", note=said.append) is done
    assert [text.partition(": ")[0] for text in said] == [
        f"longarm undo {model} --predictor {predictor}"
    ]


def test_data_that_were_refused_are_not_applied_and_no_graph_is_asked(tmp_path: Path) -> None:
    write_sample(*sample("bad_data"), tmp_path)
    client = MagicMock()
    with pytest.raises(JobError, match=r"nothing to apply: samples\.csv: x, y, z") as refused:
        apply_job.apply_on_graph(client, tmp_path)
    assert refused.value.facts["verdict"] == "bad_data"
    client.parameters.assert_not_called()


def test_a_model_that_a_node_refuses_is_put_back_with_its_predictor(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The predictor may be in another folder, where no one else would look for it."""
    model, predictor = tmp_path / "work" / "model.yaml", tmp_path / "elsewhere" / "predictor.npz"
    client, put_back = MagicMock(), MagicMock()
    client.parameters.side_effect = [(str(EXAMPLE), str(model)), (str(predictor),)]
    client.ask.return_value.success = False
    monkeypatch.setattr(apply_job, "apply", MagicMock())
    monkeypatch.setattr(apply_job, "read_addition", MagicMock())
    monkeypatch.setattr(apply_job, "undo", put_back)
    with pytest.raises(JobError, match="kinematics did not take up its file"):
        apply_job.apply_on_graph(client, tmp_path / "diagnosis")
    put_back.assert_called_once_with(model, predictor)
