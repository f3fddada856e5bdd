"""`longarm apply` and `undo` killed, or on a full disk, at every step: nothing is lost."""

import contextlib
import errno
import itertools
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from diagnosis_folders import FOUND, at_work, bytes_of, small_networks, writer
from small_arm import ARM

from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.model.model_file import load_model
from longarm_comp.workflows.apply import apply
from longarm_comp.workflows.inputs import admit_session, load_predictor
from longarm_comp.workflows.model_in_use import undo

STEPS = ("replace", "unlink")
"""Of `os`: what changes a folder. Bytes are written to files that nobody reads yet."""


class Broken(BaseException):
    """The process ended here."""


@contextmanager
def stopping(at: int, how: Callable[[], Any], before: bool) -> Iterator[list[str]]:
    """`how` is called before or after the step of this number; yields the steps made."""
    made: list[str] = []
    real = {name: getattr(os, name) for name in STEPS}

    def step(name: str) -> Callable[..., None]:
        def run(*given: Any, **named: Any) -> None:
            made.append(name)
            if before and len(made) == at:
                how()
            real[name](*given, **named)
            if not before and len(made) == at:
                how()

        return run

    with pytest.MonkeyPatch.context() as patch:
        for name in STEPS:
            patch.setattr(os, name, step(name))
        yield made


def full() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def broken() -> None:
    raise Broken


class Versions:
    """An arm with version 1 and its predictor at work, version 0 before, and a diagnosis for 2."""

    def __init__(self, diagnosed: Callable[..., Path], tmp_path: Path) -> None:
        self.model = at_work(tmp_path)
        self.predictor = self.model.parent / "predictor.npz"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("longarm_comp.workflows.apply.train", small_networks())
            apply(diagnosed("first"), ARM, self.model)
        wider = FOUND.with_values(1.5 * FOUND.values)
        self.second = diagnosed("second", before=self.model, model=wider)
        self.one = self.model.read_bytes(), self.predictor.read_bytes()
        self.two = (self.second / "model.yaml").read_bytes()
        samples = self.second.parent / "samples.csv"
        self.session = admit_session(samples, ARM, load_model(self.model, ARM))
        model = self.second / "model.yaml"
        self.trained = small_networks()(ARM, self.session, model=model)
        self.start = bytes_of(self.model.parent)

    def again(self) -> None:
        """The folder as at the beginning."""
        shutil.rmtree(self.model.parent)
        self.model.parent.mkdir()
        for name, content in self.start.items():
            (self.model.parent / name).write_bytes(content)

    def apply(self, network: bool) -> None:
        """With the session that was read and the network that was trained once."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("longarm_comp.workflows.apply.train", lambda *a, **k: self.trained)
            patch.setattr(
                "longarm_comp.workflows.inputs.admit_session", lambda *a, **k: self.session
            )
            apply(self.second, ARM, self.model, network=network)

    def check(self, network: bool) -> None:
        """Whatever happened, what is at work is whole, and the way on and the way back are open."""
        applied = self.model.read_bytes() == self.two
        if not applied:
            assert (self.model.read_bytes(), self.predictor.read_bytes()) == self.one
            self.apply(network)
        assert self.model.read_bytes() == self.two
        undo(self.model)
        assert (self.model.read_bytes(), self.predictor.read_bytes()) == self.one


@pytest.fixture(scope="module")
def trained_versions(work: Path, tmp_path_factory: pytest.TempPathFactory) -> Versions:
    folder = tmp_path_factory.mktemp("versions")
    return Versions(writer(work, folder), folder)


@pytest.fixture
def versions(trained_versions: Versions) -> Versions:
    trained_versions.again()
    return trained_versions


@pytest.mark.parametrize("network", [True, pytest.param(False, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("how", "ending"), [(full, (OSError, LongarmError)), (broken, Broken)], ids=["full", "killed"]
)
def test_apply_broken_off_anywhere_loses_nothing(
    how: Callable[[], Any], ending: Any, network: bool, versions: Versions
) -> None:
    with stopping(0, how, True) as steps:
        versions.apply(network)
    count = len(steps)
    assert count >= 6
    for at, before in itertools.product(range(1, count + 1), (True, False)):
        versions.again()
        with contextlib.suppress(ending), stopping(at, how, before):  # a file may be gone already
            versions.apply(network)
        versions.check(network)


def test_undo_broken_off_anywhere_is_finished_by_the_next(versions: Versions) -> None:
    versions.apply(network=True)
    applied = bytes_of(versions.model.parent)
    with stopping(0, broken, True) as steps:
        undo(versions.model)
    count = len(steps)
    assert count >= 3
    for at, before in itertools.product(range(1, count + 1), (True, False)):
        versions.start, kept = applied, versions.start
        versions.again()
        versions.start = kept
        with contextlib.suppress(Broken), stopping(at, broken, before):
            undo(versions.model)
        with contextlib.suppress(InputError):  # it was finished
            undo(versions.model)
        assert (versions.model.read_bytes(), versions.predictor.read_bytes()) == versions.one


@pytest.mark.parametrize("before", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_process_that_is_killed_loses_nothing(before: bool, versions: Versions) -> None:
    """As above with a process that really ends, without any clean-up."""
    for at in range(1, 9):
        versions.again()
        child = os.fork()
        if not child:
            with stopping(at, lambda: os.kill(os.getpid(), signal.SIGKILL), before):
                versions.apply(network=True)
            os._exit(0)
        os.waitpid(child, 0)
        versions.check(network=True)


def test_a_second_change_finishes_the_first(versions: Versions, tmp_path: Path) -> None:
    """Killed with the model replaced and the predictor not, the predictor that fits comes next."""
    with stopping(0, broken, True) as steps:
        versions.apply(network=True)
    for at in range(1, len(steps) + 1):
        versions.again()
        with contextlib.suppress(Broken), stopping(at, broken, False):
            versions.apply(network=True)
        if versions.model.read_bytes() != versions.two:
            continue
        with pytest.raises(InputError, match="in use already"):
            versions.apply(network=True)
        load_predictor(versions.predictor, ARM, versions.model)
