"""Trains SSA-BP on the residual of the physics."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.calibration.plausible import describe_offset
from longarm_comp.core.compensation.result import Prediction
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.learn import ensemble as networks
from longarm_comp.core.learn import predictor_file
from longarm_comp.core.learn.predictor import Predictor, Provenance
from longarm_comp.core.model.model import Model
from longarm_comp.workflows import inputs as given

if TYPE_CHECKING:
    from longarm_comp.core.learn.others import NetworkKind


def training_rows(model: Model, session: Session) -> tuple[np.ndarray, np.ndarray, Context]:
    """Return joints (M, n), residual (M, 3) in m, and circumstances of the M located rows.

    Raises InputError if there is none.
    """
    seen = session.take(session.has_position)
    if not len(seen):
        allowed = "rows with all three, to learn from"
        raise InputError(session.source, "x, y, z", "not measured together in any row", allowed)
    return seen.q, compute_tip_errors(model, seen), seen.context()


def expected_errors(predictor: Predictor, session: Session) -> Prediction:
    """Return the errors that a predictor expects at the M rows with a measured tip."""
    seen = session.take(session.placed)
    return predictor.predict(seen.q, seen.context())


@dataclass(frozen=True, eq=False, repr=False)
class TrainedPredictor(Predictor):
    """A predictor with its errors on the training rows.

    Attributes:
        samples: number of training rows.
        before, after: errors (m) on these rows of the physics alone, and with the predictor. With
            the predictor, errors on other rows are larger; see `evaluate`.
    """

    samples: int = field(kw_only=True)
    before: Errors = field(kw_only=True)
    after: Errors = field(kw_only=True)

    @property
    def summary(self) -> str:
        """The result of the training in one sentence."""
        return f"{self.samples} samples: {self.gain}"

    def save(self, path: given.FilePath) -> None:
        """Write the predictor: the paper's network as npz, another network as safetensors.

        Raises:
            JobError: the predictor does not improve on the physics, so it is not written.
        """
        if not self.gain.helps:
            raise JobError(f"not written: {self.gain}; compensate with the physics alone")
        predictor_file.save(self, path)

    def __repr__(self) -> str:
        return f"TrainedPredictor({self.summary})"


def train(
    arm: Arm,
    session: given.SessionLike,
    *,
    model: given.ModelLike | None = None,
    deflection: bool = True,
    inputs: Literal["context", "joints"] = "context",
    init: Literal["ssa", "xavier"] | None = None,
    ensemble: int = 5,
    hidden: int | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    network: NetworkKind | given.FilePath | None = None,
    note: given.Note = given.log_note,
    progress: given.Telling = False,
) -> TrainedPredictor:
    """Train SSA-BP on the residual that the physics of an arm leaves in a session.

    Args:
        session: measurements, or their CSV or bag. Rows without a marker are left out.
        model: calibrated model or its file; the declared arm when not given. A predictor that is
            trained with a file stores the hash of that file.
        deflection: False is the paper's "network only": the physics is rigid.
        inputs: ``context``: joints, approach, temperature, payload; ``joints``: as in the paper.
        init: initial weights: from sparrow search (the default) or Xavier.
        ensemble: number of networks, each from its own start.
        hidden: number of hidden units; chosen by evidence if not given.
        device: where torch trains; ``auto``: a GPU if it sees one.
        network: another network than the paper's: its file or name (docs/your_own_network.md).
        note: called with each finding of the admission.
        progress: True: print each step; or a function, called with the network being trained and
            the share done.

    Raises:
        InputError: the session was refused, has fewer than 20 rows with a marker or only one
            pose; the model is for another arm; an option is not allowed.
        JobError: the session shows the arm at another place than the model.
    """
    base, tell = given.choose_physics(arm, model, deflection), given.make_teller(progress)
    whole = given.admit_session(session, arm, None if model is None else base, note=note)
    rows = training_rows(base, whole)
    located = whole.take(whole.has_position)
    if far := describe_offset(base, located):
        raise JobError(far, session=located.source)
    if partly := int((whole.seen & ~whole.has_position).sum()):
        note(f"{whole.source}: {partly} rows hold no whole position: the network leaves them out")
    mark = given.physics_mark(model, deflection)
    origin = Provenance(arm.hash, whole.hash, arm.joint_names, mark)
    predictor = networks.train(
        *rows,
        inputs=inputs,
        init=init,
        seed=seed,
        ensemble=ensemble,
        hidden=hidden,
        device=device,
        network=given.network_kind(network),
        provenance=origin,
        progress=lambda k, of: tell(f"{k} of {of} networks", k / of),
    )
    residual = rows[1]
    left = residual - expected_errors(predictor, located).error
    return TrainedPredictor(
        **{f.name: getattr(predictor, f.name) for f in dataclasses.fields(predictor)},
        samples=len(residual),
        before=Errors.of(residual),
        after=Errors.of(left),
    )
