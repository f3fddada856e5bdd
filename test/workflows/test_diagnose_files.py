"""The folder of a diagnosis: one diagnosis at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from small_arm import ARM

from longarm_comp.core.errors import InputError, JobError
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
