"""``longarm`` as its tests run it, and an arm with everything the commands make of it."""

import json
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import yaml
from small_arm import ARM, measured

from longarm_comp.cli import run
from longarm_comp.cli.registry import COMMANDS
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import write_csv
from studies.commands import STUDIES

ENTRIES = {
    **{entry.name: (entry, "longarm_comp.cli") for entry in COMMANDS if entry.name != "study"},
    **{f"study {entry.name}": (entry, "studies") for entry in STUDIES},
}
"""Each command that does something, and the folder of its module."""


def click_command(name: str) -> click.Command:
    entry, folder = ENTRIES[name]
    return entry.load(folder)


class Shell:
    """Runs ``longarm`` in one folder and keeps what it said."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str] | None = None) -> None:
        self.folder, self._capsys = folder, capsys
        self.out = self.err = ""

    def __call__(self, *words: object) -> int:
        code = run.run([str(word) for word in words])
        if self._capsys is not None:
            self.out, self.err = self._capsys.readouterr()
        return code

    def json(self, *words: object) -> Any:
        code = self(*words, "--json")
        assert code == 0, self.err
        return json.loads(self.out)

    def refused(self, *words: object, code: int = 2) -> str:
        """The error line of a command that must fail."""
        found = self(*words)
        assert found == code, f"left with {found}: {self.err}"
        lines = [line for line in self.err.splitlines() if line.startswith("longarm: ")]
        assert "Traceback" not in self.err, self.err
        return lines[-1]


def real(q: np.ndarray) -> np.ndarray:
    """Where the tip really is: joint zeros are off, and 6 mm that geometry cannot explain."""
    share = (q - ARM.mid) / (ARM.upper - ARM.lower)
    bent = np.stack([np.cos(6 * share[:, 1]), np.sin(5 * share[:, 0]), np.cos(5 * share[:, 3])], -1)
    return Model(ARM).tip(q + np.array([0.012, -0.01, 0.001, 0.008])) + 6e-3 * bent


def on_the_real_arm(n: int, rng: np.random.Generator) -> Session:
    """n random poses, the tip where it really is, with 0.1 mm of noise."""
    session = measured(n, rng)
    noise = session.xyz - Model(ARM).tip(session.q)
    return Session.record(session.q, real(session.q) + noise)


def made_by_commands(folder: Path) -> Path:
    """An arm, sessions measured on it, a model and a predictor, made by the commands."""
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    (folder / "arm.yaml").write_text(yaml.safe_dump(data))
    rng = np.random.default_rng(3)
    write_csv(on_the_real_arm(120, rng), folder / "samples.csv")
    write_csv(on_the_real_arm(30, rng), folder / "test.csv")
    shell = Shell(folder)
    arm, samples = folder / "arm.yaml", folder / "samples.csv"
    model, predictor = folder / "model.yaml", folder / "predictor.npz"
    assert shell("calibrate", arm, samples, "-o", model) == 0
    quick = ("--ensemble", 2, "--hidden", 10)
    assert shell("train", arm, samples, "--model", model, "-o", predictor, *quick) == 0
    return folder
