"""A folder as `longarm init` makes it."""

import shutil
from pathlib import Path

import pytest
from cli_shell import Shell
from some_arms import HOBBY


@pytest.fixture(scope="module")
def hobby(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a hobby arm, to be read only."""
    folder = tmp_path_factory.mktemp("folder") / "hobby"
    assert Shell(folder.parent)("init", folder, *HOBBY) == 0
    return folder


@pytest.fixture
def mine(shell: Shell, hobby: Path) -> Path:
    """A copy of it for a test that changes files."""
    return Path(shutil.copytree(hobby, shell.folder / "mine"))
