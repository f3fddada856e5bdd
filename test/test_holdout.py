"""The hold-out is opened once, for the finished model, and changes nothing that is found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hidden_arm import at, session
from small_arm import ARM

from longarm_comp.core.data import holdout
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.identify import diagnose as core
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.practical import Gain
from longarm_comp.sim.hidden import drives

GAIN = (drives.JointGain(at(2, 0.02)),)


def diagnosed(held: object = None) -> Diagnosis:
    return core.diagnose(ARM, session(GAIN), test=held, kinds=(JointGain,))  # type: ignore[arg-type]


def test_it_is_opened_once_for_the_hash_of_the_written_model() -> None:
    found = diagnosed()
    assert len(found.holdout_uses) == 1
    assert found.holdout_uses == (core._hash(found.model),)
    other = dataclasses.replace(
        found.model, effects=tuple(e for e in found.model.effects if e.name != "joint_gain")
    )
    (gain,) = (e for e in found.model.effects if isinstance(e, JointGain))
    more = other.plus(dataclasses.replace(gain, gain=gain.gain + 1e-12))
    assert len({core._hash(m) for m in (found.model, other, more)}) == 3


def test_who_reads_it_before_the_model_is_final_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """A diagnosis that looks at the rows while it examines them is refused."""
    made: list[holdout.Sealed] = []

    class Watched(holdout.Sealed):
        def release(self, finished: str) -> None:
            with pytest.raises(holdout.SealedError, match="once the fit is finished"):
                self.open("to look")
            made.append(self)
            super().release(finished)

    monkeypatch.setattr(core, "Sealed", Watched)
    assert diagnosed().holdout_uses == made[0].uses


def test_what_is_held_out_selects_nothing() -> None:
    """Poses of another arm, and none that show the gain: the same model to the last bit."""
    rng = np.random.default_rng(0)
    held = session(GAIN, n=60, seed=9)
    spoilt = dataclasses.replace(held, xyz=held.xyz + 0.05 * rng.standard_normal(held.xyz.shape))
    fair, unfair = diagnosed(held), diagnosed(spoilt)
    assert fair.model == unfair.model
    assert fair.written == unfair.written == "with_effects"
    assert (fair.verdict, fair.structure.flag) == ("named", False)
    assert unfair.structure.sign == "shows in the held-out poses"  # it is said, and no more
    assert [f.name for f in unfair.findings] == ["joint_gain"]
    assert fair.holdout_uses == unfair.holdout_uses
    assert fair.proof.rows["with_effects"].mean < 0.8 * fair.proof.rows["calibrated"].mean
    assert unfair.proof.rows["with_effects"].mean > 0.03


def test_a_gain_is_as_sure_as_its_blocks(rng: np.random.Generator) -> None:
    """Errors that last for a block leave fewer independent ones than rows."""
    lasting = np.repeat(1.0 + 0.1 * rng.standard_normal(20), 50)
    before = np.outer(lasting, [1.0, 0.0, 0.0])
    low, high = Gain.of(before, 0.0 * before).ci95
    assert low < lasting.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * lasting.std() / np.sqrt(20), rel=0.05)
    low, high = Gain.of(before, before).ci95
    assert low == high == 0.0
