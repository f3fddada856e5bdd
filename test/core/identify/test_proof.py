"""The proof: what a network promises is taken from the errors of the model that it stands on."""

import dataclasses
from pathlib import Path

import numpy as np
from cli_shell import on_the_real_arm
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.commanded import commanded_errors
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.identify.proof import NETWORK, Fold, prove_models
from longarm_comp.core.learn.predictor_file import load
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model_file import load_model
from longarm_comp.sessions.read import read_session
from studies.touch import EXAMPLE


def test_a_network_is_proved_by_the_error_that_it_takes_away(work: Path) -> None:
    model, learned = load_model(work / "model.yaml", ARM), load(work / "predictor.npz")
    rows = on_the_real_arm(40, np.random.default_rng(11))
    q = rows.q.copy()
    q[0] += 2.0 * (ARM.upper - ARM.lower)  # where it knows nothing
    rows = dataclasses.replace(rows, q=q)
    promised = learned.predict(rows.q, rows.context())
    assert not promised.in_domain[0] and promised.in_domain.sum() > 20
    known = np.where(promised.in_domain[:, None], promised.error, 0.0)
    fold = Fold({"calibrated": model}, {}, rows, np.arange(len(rows)))
    proof = prove_models([fold], lambda _: (model, learned))
    inside = promised.in_domain
    for told, of in ((proof.errors, compute_tip_errors), (proof.commanded, commanded_errors)):
        np.testing.assert_allclose(told["calibrated"], of(model, rows))
        np.testing.assert_allclose(told[NETWORK], of(model, rows) - known)
        before, after = (
            np.linalg.norm(told[name][inside], axis=1).mean() for name in ("calibrated", NETWORK)
        )
        assert after < 0.8 * before, (after, before)
    without = prove_models([fold])
    assert NETWORK not in without.errors


def test_a_touch_that_is_alone_in_its_fold_is_no_row_of_the_proof() -> None:
    """Its point is solved from it, so it tells nothing; the rows of the errors are the others."""
    panda = Arm.load(EXAMPLE / "arm.yaml")
    session = read_session(EXAMPLE / "panda_1.csv", panda)
    session = dataclasses.replace(session, touch_distances=())
    touched = session.labels["touch"]
    several, alone = np.unique(touched)[:2]
    at = np.r_[np.flatnonzero(touched == several)[:3], np.flatnonzero(touched == alone)[:1]]
    proof = prove_models(
        [Fold({"nominal": declared_model(panda)}, {}, session.take(at), np.arange(4))]
    )
    assert proof.rows_at.tolist() == [0, 1, 2]
    assert len(proof.errors["nominal"]) == 3
