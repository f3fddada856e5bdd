"""Folders as a diagnosis of the small arm leaves them, and what `apply` makes beside them."""

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import report_samples
from small_arm import ARM

from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.plays import FrictionHysteresis
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, read_stored, save_model, store
from longarm_comp.report import record
from longarm_comp.workflows.inputs import admit_session, file_hash
from longarm_comp.workflows.train import TrainedPredictor, train

FOUND = Model(ARM, (*JointZero.for_arm(ARM), FrictionHysteresis(1, width=0.004)))


def writer(work: Path, tmp_path: Path) -> Callable[..., Path]:
    """Writes the folder of a diagnosis of the session in ``work``, into a folder."""

    def write(
        name: str = "diagnosis",
        *,
        before: Path | None = None,
        verdict: str = "named",
        model: Model = FOUND,
        **more: Any,
    ) -> Path:
        folder = tmp_path / name
        shutil.copy(work / "samples.csv", tmp_path / "samples.csv")
        known = None if before is None else load_model(before, ARM)
        provenance = {
            "session_hash": admit_session(tmp_path / "samples.csv", ARM, known).hash,
            "model_before": "" if before is None else file_hash(before),
            "session": "../samples.csv",
            **more,
        }
        version = 1 if before is None else read_stored(before).version + 1
        save_model(folder / "model.yaml", store(model, version=version, provenance=provenance))
        made, _ = getattr(report_samples, verdict)(np.random.default_rng(1))
        made["provenance"]["data_sha256"] = provenance["session_hash"]
        (folder / "report.json").write_text(record.text(record.parse_report(made)))
        return folder

    return write


def at_work(tmp_path: Path) -> Path:
    return tmp_path / "work" / "model.yaml"


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def small_networks() -> Callable[..., TrainedPredictor]:
    """`train`, in a tenth of the time."""
    return functools.partial(train, ensemble=1, hidden=8, init="xavier")
