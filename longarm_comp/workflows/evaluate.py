"""Evaluates every stage of a model on measured poses, as in the paper's Table I."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.calibration.placed_model import place_as_seen
from longarm_comp.core.calibration.plausible import describe_offset
from longarm_comp.core.data.commanded import commanded_errors
from longarm_comp.core.data.measurement import (
    compute_tip_errors,
    compute_touch_errors,
    compute_turn_errors,
)
from longarm_comp.core.html_table import html_table
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import read_stored
from longarm_comp.workflows import inputs
from longarm_comp.workflows.train import expected_errors


@dataclass(frozen=True, repr=False)
class ErrorTable(Mapping[str, Errors]):
    """Errors (m) of each model by its name, from the simplest on: ``table["calibrated"].mean``.

    Attributes:
        errors: errors as seen: the model uses everything that was measured (docs/report.md).
        commanded: errors as commanded: it uses only what a command knows
            (`core/data/commanded.py`).
        set_aside: number of fitted rows that a model's fit set aside as outliers.
    """

    errors: Mapping[str, Errors]
    commanded: Mapping[str, Errors]
    set_aside: Mapping[str, int] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Errors:
        return self.errors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.errors)

    def __len__(self) -> int:
        return len(self.errors)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """One row per model, in millimetres (and mrad), under the names of report.json."""
        rows = []
        for name, seen in self.errors.items():
            mean, *others = seen.mm.items()
            commanded = ("commanded_mean_mm", self.commanded[name].mm["mean_mm"])
            row: dict[str, Any] = {"model": name, "n": seen.n, **dict([mean, commanded, *others])}
            # Where the orientation was measured, and where points were touched: mean distance
            further = {"mean_mrad": seen.angle, "spread_mm": seen.spread}
            row |= {key: 1e3 * value for key, value in further.items() if value is not None}
            if name in self.set_aside:
                row["set_aside"] = self.set_aside[name]
            rows.append(row)
        return rows

    def _repr_html_(self) -> str:
        return html_table("errors on rows that were not fitted", self.rows)

    def __repr__(self) -> str:
        import pandas as pd

        return str(pd.DataFrame(self.rows).to_string(index=False, float_format="{:.3f}".format))


@dataclass(frozen=True, repr=False)
class Evaluation(ErrorTable):
    """Errors by stage: `rigid`, `deflection` (beams), `calibrated` (model), `network` (predictor).

    Attributes:
        placed: whether the declared arm was first placed by the rows, because they show it at
            another place than declared.
        elsewhere: whether the rows show it at another place, but are too few to place and judge it.
        outside: number of poses outside the network's domain, where physics is used alone.
        refused: number of further poses at which the network promises no gain over the physics.
        fitted: which of ``model`` and ``predictor`` were fitted to this session. It is not known
            for a model in memory.
    """

    outside: int = 0
    refused: int = 0
    placed: bool = False
    elsewhere: bool = False
    fitted: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return "\n".join([super().__repr__(), *self.notes])

    @property
    def notes(self) -> list[str]:
        """Sentences to show with the table: the worst rows, and how the models were used."""
        last = list(self)[-1]
        worst = [f"{row} ({1e3 * size:.3g} mm)" for row, size in self[last].worst]
        said = [f"worst rows of {last}, by index: {', '.join(worst)}"] if worst else []
        if self.placed:
            why = "because they see it elsewhere"
            said.append(f"the declared arm was placed by these rows first, {why}")
        if self.elsewhere:
            said.append(
                "these rows see the declared arm elsewhere, and tell hardly more than where: "
                "it is judged where it is declared"
            )
        if self.outside:
            where = "outside the network's training data"
            said.append(f"{self.outside} poses lie {where}: physics only")
        if self.refused:
            said.append(f"at {self.refused} poses the network promises no gain: physics only")
        return said


def evaluate(
    arm: Arm,
    test: inputs.SessionLike,
    *,
    model: inputs.ModelLike | None = None,
    predictor: Predictor | inputs.FilePath | None = None,
    note: inputs.Note = inputs.log_note,
) -> Evaluation:
    """Compute the errors of every stage on measured poses.

    Args:
        test: measured poses, or their CSV or bag; rows without a marker do not count.
        model: calibrated model, or its file.
        predictor: predictor trained with this model, or its file. At poses outside its domain the
            physics is used alone.
        note: called with each finding of the admission.

    Raises:
        InputError: the session cannot be read, or is in other units; the model or the predictor
            is for another arm, or the predictor for another model.
    """
    calibrated = None if model is None else inputs.choose_physics(arm, model)
    session = inputs.admit_session(test, arm, calibrated, min_poses=1, note=note, judge=True)
    rigid = place_as_seen(inputs.choose_physics(arm, None, False), session)
    models, elsewhere = {"rigid": rigid.model}, rigid.elsewhere and not rigid.placed
    if arm.links:
        models["deflection"] = place_as_seen(inputs.choose_physics(arm, None), session).model
    if calibrated is not None:
        if far := describe_offset(calibrated, session):
            note(far)
        models["calibrated"] = calibrated
    taken_off = {name: np.zeros(3) for name in models}
    outside, refused, learned = 0, 0, None
    if predictor is not None:
        if isinstance(predictor, Predictor):
            inputs.check_predictor(predictor, inputs.choose_physics(arm, model), "predictor")
            learned = predictor
        else:
            learned = inputs.load_predictor(predictor, arm, model)
        beside = learned.provenance.beside_deflection
        found = expected_errors(learned, session)
        inside = np.asarray(found.in_domain)
        outside = int(found.outside.sum())
        refused = int((~inside).sum()) - outside
        inside = inside & session.has_position[session.placed]
        beneath = inputs.choose_physics(arm, model, beside)
        models["network"] = beneath if model is not None else place_as_seen(beneath, session).model
        taken_off["network"] = np.where(inside[:, None], found.error, 0.0)
    file = None if model is None or isinstance(model, Model) else Path(model)
    numbers = session.index[session.placed]
    seen, commanded = (
        {
            name: Errors.of(
                left(each, session) - taken_off[name],
                compute_turn_errors(each, session),
                numbers=numbers,
                spread=compute_touch_errors(each, session),
            )
            for name, each in models.items()
        }
        for left in (compute_tip_errors, commanded_errors)
    )
    # A session that shares only some rows with this one has another hash
    origins = {
        "model": None if file is None else read_stored(file).provenance.get("session_hash"),
        "predictor": None if learned is None else learned.provenance.session_hash,
    }
    fitted = tuple(name for name, origin in origins.items() if origin == session.hash)
    return Evaluation(seen, commanded, {}, outside, refused, rigid.placed, elsewhere, fitted)
