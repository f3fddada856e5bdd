"""Arms of one kind as a prior of the next: planted directions, six real Pandas, refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from few_effects import few_effects
from touching import ARM, EXAMPLE

import longarm_comp as la
from longarm_comp.cli.diagnose import command as diagnose
from longarm_comp.cli.fit import calibrate as command
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.kind_of_arm import KindOfArm, fold_directions
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.measurement import compute_touch_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.effects.geometry_errors import DhError, JointZero, KindDirection
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import read_stored, save_model, store
from longarm_comp.workflows.calibrate import kind_from

NAMES = ("1", "2", "3", "4", "6", "7")
ROWS, DRAWS = 6, 1


def touches(name: str) -> Session:
    return la.read_session(EXAMPLE / f"panda_{name}.csv", ARM)


@pytest.fixture(scope="module")
def models() -> dict[str, Model]:
    """Every real arm, calibrated with every second of its rows."""
    rows = {name: touches(name).take(slice(0, None, 2)) for name in NAMES}
    fits = {n: dict(fit_stages(declared_model(ARM), rows[n]))["geometry"] for n in NAMES}
    return {name: fit.model.lasting() for name, fit in fits.items()}


def fitted(rows: Session, kind: KindOfArm | None) -> ModelFit:
    """The full geometry."""
    return dict(fit_stages(declared_model(ARM), rows, kind=kind))["geometry"]


def arms_along(direction: np.ndarray, n: int = 8) -> list[Model]:
    """Arms whose zeros differ in one direction (rad) and hardly otherwise."""
    rng = np.random.default_rng(0)
    made = []
    for _ in range(n):
        zeros = rng.standard_normal() * direction + 1e-6 * rng.standard_normal(ARM.n)
        terms = [JointZero(joint=j, offset=z) for j, z in enumerate(zeros, 1)]
        made.append(Model(ARM, (*terms, *DhError.for_arm(ARM))))
    return made


def test_what_arms_share_is_the_direction_of_the_prior() -> None:
    direction = 4e-3 * np.array([1.0, -2.0, 0.5, 0.0, 3.0, 0.0, 1.0])
    kind = KindOfArm.of(ARM, arms_along(direction), ["a"] * 8)

    def size(one: KindDirection) -> float:
        return sum(abs(t.offset) for t in one.terms if isinstance(t, JointZero))

    largest = max(kind.directions, key=size)
    found = np.array([t.offset for t in largest.terms if isinstance(t, JointZero)])
    along = abs(found @ direction) / np.linalg.norm(found) / np.linalg.norm(direction)
    assert along > 0.9999
    assert 0.4 < np.linalg.norm(found) / np.linalg.norm(direction) < 1.6
    assert 0.0 < kind.rest < 0.5


def test_arms_that_share_nothing_leave_the_drawing() -> None:
    """Independent errors of one tolerance each are the prior without other arms."""
    rng = np.random.default_rng(1)
    blank = Model(ARM, (*JointZero.for_arm(ARM), *DhError.for_arm(ARM)))
    widths = np.array([s.parameter.width for s in blank.slots])
    arms = [blank.with_values(widths * rng.standard_normal(len(widths))) for _ in range(300)]
    kind = KindOfArm.of(ARM, arms, ["a"] * 300)
    applied = kind.apply_to(blank)
    made = [d for d in applied.effects if isinstance(d, KindDirection)]
    total = kind.rest**2 * len(widths)
    for d in made:
        total += sum(
            (getattr(t, p.name) / p.prior) ** 2
            for t in d.terms for p in t.parameters(ARM) if p.prior > 0
        )  # fmt: skip
    assert total == pytest.approx(len(widths), rel=0.1)
    own = [s.parameter.width for s in applied.slots if s.owner.name != "kind_direction"]
    np.testing.assert_allclose(own, kind.rest * widths)


def test_a_folded_fit_predicts_the_same_and_holds_no_direction(models: dict[str, Model]) -> None:
    give = JointCompliance(joint=2, compliance=1e-5)
    others = [model.plus(give) for name, model in models.items() if name != "2"]
    kind = KindOfArm.of(ARM, others, list("13467"))
    rows = touches("2").take(slice(0, 40))
    *_, (_, fit) = fit_stages(declared_model(ARM), rows, kind=kind)
    assert any(isinstance(e, KindDirection) for e in fit.model.effects)
    whole = fold_directions(fit)
    assert not any(isinstance(e, KindDirection) for e in whole.model.effects)
    assert whole.model.tolerances == 1.0
    assert any(e.compliance != 0 for e in whole.model.effects if isinstance(e, JointCompliance))
    q = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (50, ARM.n))
    np.testing.assert_allclose(whole.model.tip(q), fit.model.tip(q), atol=1e-5)
    shape = (len(whole.slots),) * 2
    assert whole.covariance.shape == shape
    assert whole.columns.shape == (*whole.residual.shape, shape[0])
    for fitted in (fit, whole):  # the tip is known as well as before
        columns = fitted.model.columns(fitted.posture)[1]
        tip = np.einsum("nip,pq,niq->n", columns, fitted.covariance, columns)
        if fitted is fit:
            before = tip
    np.testing.assert_allclose(tip, before, rtol=0.02)


def test_few_rows_of_a_real_arm_do_better_by_its_kind(models: dict[str, Model]) -> None:
    """Six rows at one place, tested at the others: 1.5 mm by the drawing, 1.0 mm by the kind."""
    left = []
    for name in NAMES[:4]:
        kind = KindOfArm.of(
            ARM,
            [model for other, model in models.items() if other != name],
            [other for other in NAMES if other != name],
            {"touch": 2e-4},
        )
        session, rng = touches(name), np.random.default_rng(int(name))
        location = session.labels["location"]
        for _ in range(DRAWS):
            place = rng.choice(np.unique(location))
            rows = np.sort(rng.choice(np.flatnonzero(location == place), ROWS, replace=False))
            few, rest = session.take(rows), session.take(location != place)
            fits = [
                dict(fit_stages(declared_model(ARM), few, kind=k))["geometry"] for k in (None, kind)
            ]
            left.append(
                [1e3 * compute_touch_errors(fold_directions(f).model, rest).mean() for f in fits]
            )
    drawing, by_kind = np.mean(left, axis=0)
    assert by_kind < 1.3
    assert by_kind < 0.7 * drawing


@pytest.mark.long
def test_many_rows_are_not_worse_by_their_kind(models: dict[str, Model]) -> None:
    left = []
    for name in NAMES:
        others = [other for other in NAMES if other != name]
        kind = KindOfArm.of(ARM, [models[o] for o in others], others, {"touch": 2e-4})
        session = touches(name)
        location = session.labels["location"]
        place = np.unique(location)[0]
        few = session.take(np.flatnonzero(location == place)[:40])
        fits = [fitted(few, each) for each in (None, kind)]
        rest = session.take(location != place)
        left.append(
            [1e3 * compute_touch_errors(fold_directions(f).model, rest).mean() for f in fits]
        )
    drawing, by_kind = np.mean(left, axis=0)
    assert by_kind < 1.02 * drawing


def test_the_command_reads_models_and_says_which(tmp_path: Path, models: dict[str, Model]) -> None:
    files = []
    for name, noise in {"1": 1e-4, "3": 4e-4, "4": 2e-4}.items():
        files.append(tmp_path / f"m{name}.yaml")
        save_model(files[-1], store(models[name], provenance={"noise_touch": noise}))
    kind, origin = kind_from(ARM, files)
    assert kind.noise == {"touch": pytest.approx(2e-4)}
    out = tmp_path / "model.yaml"
    words = [str(EXAMPLE / "arm.yaml"), str(EXAMPLE / "panda_7.csv")]
    done = CliRunner().invoke(
        command, [*words, "-o", str(out), "--kind-of", *map(str, files), "--json"]
    )
    assert done.exit_code == 0, done.output
    stored = read_stored(out)
    assert stored.provenance["kind_of"] == origin
    assert 5e-5 < stored.provenance["noise_touch"] < 1e-3  # for the next of the kind
    assert all(name in origin for name in ("m1.yaml", "m3.yaml", "m4.yaml"))
    assert {t.effect for t in stored.geometry} == {"joint_zero", "dh_error", "tip_offset"}
    refused = CliRunner().invoke(command, [*words, "further.yaml"])
    assert refused.exit_code == 2
    assert "unexpected: further.yaml" in refused.output


def test_a_diagnosis_expects_what_the_kind_has(tmp_path: Path, models: dict[str, Model]) -> None:
    """Few rows at one place; what is written holds errors of the drawing, and no direction."""
    whole = touches("4")
    location = whole.labels["location"]
    one = np.unique(location)[0]
    few = whole.take(np.flatnonzero(location == one)[:8])
    rest = whole.take(np.flatnonzero(location != one)[::3])
    others = [models[name] for name in NAMES if name != "4"]
    with few_effects((JointGain, JointCompliance)):
        found = la.diagnose(ARM, few, test=rest, kind_of=others, network=False)
    by_drawing = compute_touch_errors(fitted(few, None).model, rest).mean()
    assert compute_touch_errors(found.model, rest).mean() < 0.9 * by_drawing
    assert found.model.tolerances == 1.0
    assert not any(isinstance(e, KindDirection) for e in found.model.effects)
    assert found.facts["kind of"] == ", ".join(f"model {k}" for k in range(1, 6))
    la.load_model(found.save(tmp_path) / "model.yaml", ARM)


def test_the_command_diagnoses_by_kind(tmp_path: Path) -> None:
    files = (EXAMPLE / "arm.yaml", EXAMPLE / "panda_4.csv", "-o", tmp_path / "out")
    words = [str(file) for file in files]
    done = CliRunner().invoke(diagnose, [*words, "further.yaml"])
    assert done.exit_code == 2
    assert "unexpected: further.yaml" in done.output
    done = CliRunner().invoke(diagnose, [*words, "--kind-of", "a.yaml", "b.yaml", "c.yaml"])
    assert isinstance(done.exception, InputError)
    assert "a.yaml" in str(done.exception)


def test_arms_of_another_kind_are_refused(models: dict[str, Model]) -> None:
    joints = list(ARM.joints)
    joints[2] = joints[2].model_copy(update={"d_m": 0.416})
    longer = dataclasses.replace(models["1"], arm=ARM.model_copy(update={"joints": tuple(joints)}))
    others = [models["2"], models["3"], longer]
    with pytest.raises(InputError, match=r"c: joints.2.d_m: 0.416; allowed: 0.316, as panda"):
        KindOfArm.of(ARM, others, ["a", "b", "c"])
    with pytest.raises(InputError, match="models: 2; allowed: at least 3"):
        KindOfArm.of(ARM, others[:2], ["a", "b"])
