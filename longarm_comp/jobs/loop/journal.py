"""Steps that a loop has done, in one file, so that it goes on after an interruption."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_text
from longarm_comp.jobs.targets import Trial

_TRIAL = ("target", "seen", "true", "status")


class Journal:
    """Results of steps by name, written after each.

    Args:
        facts: of the job, which must be those that it was begun with.
    """

    def __init__(self, path: Path, facts: dict[str, Any], *, resume: bool) -> None:
        self._path = path
        self._steps: dict[str, Any] = {"settings": facts}
        if not path.is_file():
            return
        if not resume:
            raise InputError(path, "file", "exists", "a new folder, or --resume")
        try:
            self._steps = json.loads(path.read_text(encoding="utf-8"))
            begun = dict(self._steps["settings"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(path, "json", str(error), "a file that longarm loop wrote") from error
        for name, value in facts.items():
            if begun.get(name) != value:
                raise InputError(path, name, value, f"{begun.get(name)}, as it was begun")

    def __contains__(self, step: str) -> bool:
        """Whether a step was done."""
        return step in self._steps

    def once(self, step: str, make: Callable[[], Any]) -> Any:
        """The result of a step as plain data, made now unless it was made before."""
        if step not in self._steps:
            self._steps[step] = make()
            write_text(self._path, json.dumps(self._steps))
        return self._steps[step]

    def trial(self, step: str, make: Callable[[], Trial]) -> Trial:
        """The same for a run over targets."""
        return _trial(self.once(step, lambda: _plain(make())))


def _plain(trial: Trial) -> dict[str, Any]:
    return {"name": trial.name, **{name: getattr(trial, name).tolist() for name in _TRIAL}}


def _trial(data: dict[str, Any]) -> Trial:
    return Trial(data["name"], *(np.array(data[name]) for name in _TRIAL))
