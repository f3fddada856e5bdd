"""`longarm apply` and `longarm undo` on files: what is refused, what changes, what comes back."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli_shell import Shell
from diagnosis_folders import FOUND, at_work, bytes_of, small_networks, writer
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.plays import FrictionHysteresis
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.learn import predictor_file
from longarm_comp.core.learn.predictor import LearnedGain
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, read_stored, save_model, store
from longarm_comp.report import record
from longarm_comp.workflows.apply import apply, list_changes, take_back
from longarm_comp.workflows.inputs import file_hash, load_predictor
from longarm_comp.workflows.model_in_use import undo
from longarm_comp.workflows.train import TrainedPredictor


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("longarm_comp.workflows.apply.train", small_networks())
        yield


@pytest.fixture
def diagnosed(work: Path, tmp_path: Path) -> Callable[..., Path]:
    """Writes folders of diagnoses."""
    return writer(work, tmp_path)


def kept_of(model: Path) -> str:
    """Name of the predictor that was trained with a model, while it is not at work."""
    return f"predictor.of_{file_hash(model)[:12]}.npz"


def test_a_first_diagnosis_on_the_declared_arm_and_back(
    diagnosed: Callable[..., Path], tmp_path: Path, shell: Shell
) -> None:
    model, folder = at_work(tmp_path), diagnosed()
    done = apply(folder, ARM, model)
    assert model.read_bytes() == (folder / "model.yaml").read_bytes()
    assert done.version == 1
    assert done.predictor == model.parent / "predictor.npz"
    load_predictor(done.predictor, ARM, model)
    assert done.set_aside is None
    with pytest.raises(InputError, match="in use already"):
        apply(folder, ARM, model)

    assert shell(*done.undo.split()[1:]) == 0
    assert read_stored(model).version == 0
    q = ARM.mid[None]
    np.testing.assert_array_equal(load_model(model, ARM).tip(q), declared_model(ARM).tip(q))
    assert sorted(bytes_of(model.parent)) == ["model.yaml", kept_of(folder / "model.yaml")]
    assert "previous version" in shell.refused("undo", model)
    apply(folder, ARM, model, network=False)  # the declared arm is at work, as it was diagnosed
    assert model.read_bytes() == (folder / "model.yaml").read_bytes()


def test_a_network_that_does_not_help_is_not_put_to_work(
    diagnosed: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def useless(*given: Any, **named: Any) -> TrainedPredictor:
        made = small_networks()(*given, **named)
        return dataclasses.replace(made, gain=LearnedGain(1e-4, 2e-4, -1e-4))

    monkeypatch.setattr("longarm_comp.workflows.apply.train", useless)
    model, said = at_work(tmp_path), []
    done = apply(diagnosed(), ARM, model, note=said.append)
    assert done.predictor is None and not (model.parent / "predictor.npz").exists()
    assert "the network leaves 0.200 mm, the physics alone 0.100 mm" in done.refused
    assert f"physics only: {done.refused}" in said
    assert model.is_file()


def test_undo_restores_model_and_predictor_byte_for_byte(
    diagnosed: Callable[..., Path], tmp_path: Path
) -> None:
    model = at_work(tmp_path)
    apply(diagnosed("first"), ARM, model)
    before = {k: v for k, v in bytes_of(model.parent).items() if "previous" not in k}
    wider = FOUND.with_values(1.5 * FOUND.values)
    second = diagnosed("second", before=model, model=wider)
    done = apply(second, ARM, model)
    assert done.version == 2
    assert done.set_aside is not None
    assert done.set_aside.name == kept_of(model.parent / "model.previous.yaml")
    load_predictor(model.parent / "predictor.npz", ARM, model)
    assert undo(model) == model.parent / "predictor.npz"
    after = bytes_of(model.parent)
    assert {name: after[name] for name in before} == before
    load_predictor(model.parent / "predictor.npz", ARM, model)

    without = apply(second, ARM, model, network=False)
    assert without.predictor is None
    assert not (model.parent / "predictor.npz").exists()  # it does not fit this version
    undo(model)
    after = bytes_of(model.parent)
    assert {name: after[name] for name in before} == before


def test_the_predictor_of_a_network_of_others_is_kept_and_returns(
    diagnosed: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its network is not there: it is a file of others, which neither command is given."""
    model, net = at_work(tmp_path), at_work(tmp_path).with_name("net.safetensors")
    apply(diagnosed("first"), ARM, model)
    papers = predictor_file.load(model.with_name("predictor.npz"))
    others: Any = SimpleNamespace(name="mine.py", origin=64 * "0")
    predictor_file.save(dataclasses.replace(papers, hidden=0, network=others), net)
    model.with_name("predictor.npz").unlink()
    before, first = net.read_bytes(), file_hash(model)
    wider = FOUND.with_values(1.5 * FOUND.values)
    second = diagnosed("second", before=model, model=wider)
    with monkeypatch.context() as patch:
        patch.setattr("longarm_comp.workflows.apply.train", pytest.fail)
        with pytest.raises(InputError, match=r"net\.safetensors: predictor file: 'ends in \."):
            apply(second, ARM, model, net)
    done = apply(second, ARM, model, net, network=False)
    assert done.set_aside == net.with_name(f"net.of_{first[:12]}.safetensors")
    assert not net.exists()
    assert undo(model) == net
    assert net.read_bytes() == before


def test_a_predictor_in_another_folder_returns_too(
    diagnosed: Callable[..., Path], tmp_path: Path, shell: Shell
) -> None:
    model, predictor = at_work(tmp_path), tmp_path / "elsewhere" / "predictor.npz"
    apply(diagnosed("first"), ARM, model, predictor)
    before = predictor.read_bytes()
    wider = FOUND.with_values(1.5 * FOUND.values)
    second = diagnosed("second", before=model, model=wider)
    for taken_back in (
        lambda: undo(model, predictor),
        lambda: take_back(second, model, predictor),
        lambda: shell("undo", model, "--predictor", predictor),
    ):
        apply(second, ARM, model, predictor)
        assert predictor.read_bytes() != before
        taken_back()
        assert predictor.read_bytes() == before
        load_predictor(predictor, ARM, model)


def test_a_diagnosis_older_than_the_model_at_work_is_refused(
    diagnosed: Callable[..., Path], tmp_path: Path
) -> None:
    model = at_work(tmp_path)
    first, rival = diagnosed("first"), diagnosed("rival", verdict="partly", seed=2)
    apply(first, ARM, model, network=False)
    kept = bytes_of(model.parent)
    with pytest.raises(InputError, match=f"diagnose with --model {model}"):
        apply(rival, ARM, model)
    other = tmp_path / "other.yaml"
    save_model(other, store(FOUND.with_values(1.1 * FOUND.values)))
    with pytest.raises(InputError, match="model in use"):
        apply(diagnosed("of_another_model", before=other), ARM, model)
    assert bytes_of(model.parent) == kept
    with pytest.raises(InputError, match="declared arm"):
        apply(diagnosed("of_a_model", before=other), ARM, tmp_path / "none" / "model.yaml")


def held_out(
    folder: Path, nominal_mm: float, with_effects_mm: float, after: str = "with_effects"
) -> None:
    """Writes these held-out means as commanded into a diagnosis; as seen they fall to a tenth."""
    report = record.read_report(folder)
    row = dict.fromkeys(record.ErrorRow.model_fields, 0.0)
    rows = [
        record.ErrorRow.model_validate(
            {**row, "model": name, "mean_mm": seen, "commanded_mean_mm": commanded}
        )
        for name, seen, commanded in (
            ("nominal", 1.0, nominal_mm),
            ("with_effects", 0.1, with_effects_mm),
        )
    ]
    table = report.held_out.model_copy(update={"rows": rows, "after": after})
    written = record.Written(model="with_effects", expected_commanded_mm={})
    changed = report.model_copy(update={"held_out": table, "written": written})
    (folder / "report.json").write_text(record.text(changed))


@pytest.mark.parametrize("verdict", ["noise", "unknown", "bad_data"])
def test_a_diagnosis_that_adds_nothing_is_refused(
    verdict: str, diagnosed: Callable[..., Path], tmp_path: Path
) -> None:
    folder = diagnosed(verdict=verdict)
    held_out(folder, 1.0, 0.95)
    with pytest.raises(JobError, match="nothing to apply"):
        apply(folder, ARM, at_work(tmp_path))
    assert not at_work(tmp_path).exists()
    held_out(folder, 1.0, 0.95, after="with_network")  # one that helped is something to add
    if verdict != "bad_data":
        apply(folder, ARM, at_work(tmp_path), network=False)


def test_a_calibration_that_lowers_the_error_is_worth_it(
    diagnosed: Callable[..., Path], tmp_path: Path
) -> None:
    folder = diagnosed(verdict="noise")
    held_out(folder, 1.0, 0.95)
    with pytest.raises(JobError, match="nothing to apply"):
        apply(folder, ARM, at_work(tmp_path), network=False)
    held_out(folder, 1.0, 0.85)
    done = apply(folder, ARM, at_work(tmp_path), network=False)
    assert (done.commanded_mm, done.seen_mm) == ((1.0, 0.85), (1.0, 0.1))


def test_other_arms_sessions_and_folders_are_refused(
    diagnosed: Callable[..., Path], tmp_path: Path
) -> None:
    model, folder = at_work(tmp_path), diagnosed()
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    other = Arm.parse({**data, "name": "another"}, "another arm")
    with pytest.raises(InputError, match=r"arm\.hash"):
        apply(folder, other, model)
    with pytest.raises(InputError, match="longarm diagnose wrote"):
        apply(tmp_path / "none", ARM, model)
    samples = tmp_path / "samples.csv"
    lines = samples.read_text().splitlines()
    samples.write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(InputError, match="the session diagnosed"):
        apply(folder, ARM, model)
    samples.unlink()
    with pytest.raises(InputError, match="--session"):
        apply(folder, ARM, model)
    samples.write_text("\n".join(lines) + "\n")
    moved = samples.rename(tmp_path / "moved.csv")
    apply(folder, ARM, model, session=moved, network=False)
    unchained = diagnosed("unchained")
    text = (unchained / "model.yaml").read_text()
    (unchained / "model.yaml").write_text(text.replace("  model_before: ''\n", ""))
    with pytest.raises(InputError, match="model_before"):
        apply(unchained, ARM, tmp_path / "other" / "model.yaml")


def test_the_changes_are_those_of_the_values(rng: np.random.Generator) -> None:
    q = ARM.lower + rng.random((30, ARM.n)) * (ARM.upper - ARM.lower)
    context = Context(approach=tuple(rng.choice([-1.0, 1.0], (ARM.n, 30))))
    assert list_changes(FOUND, FOUND, q, context) == []
    terms = list(FOUND.effects)
    terms[-1] = FrictionHysteresis(1, width=0.006)
    grown = dataclasses.replace(FOUND, effects=tuple(terms))
    (change,) = list_changes(FOUND, grown, q, context)
    assert (change.what, change.where, change.kind) == ("friction_hysteresis", "joint 1", "changed")
    assert change.values == (("width", "rad", 0.004, 0.006),)
    moved = np.linalg.norm(grown.tip(q, context) - FOUND.tip(q, context), axis=1)
    assert change.tip_mm == pytest.approx(1e3 * np.sqrt((moved**2).mean()))

    bare = Model(ARM, tuple(terms[:-1]))
    (added,) = list_changes(bare, grown, q, context)
    (removed,) = list_changes(grown, bare, q, context)
    assert (added.kind, removed.kind) == ("added", "removed")
    assert "width none -> 0.3438 °" in str(added)
    zeros = FOUND.with_values(FOUND.values + np.r_[1e-3, np.zeros(len(FOUND.values) - 1)])
    (geometry,) = list_changes(FOUND, zeros, q, context)
    assert (geometry.what, geometry.where) == ("geometry", "")
    moved = np.linalg.norm(zeros.tip(q, context) - FOUND.tip(q, context), axis=1)
    assert geometry.tip_mm == pytest.approx(1e3 * np.sqrt((moved**2).mean()))


def test_files_that_are_no_predictors_are_left_alone_by_undo(
    diagnosed: Callable[..., Path], tmp_path: Path
) -> None:
    model = at_work(tmp_path)
    apply(diagnosed(), ARM, model, network=False)
    np.savez(model.parent / "other.npz", a=np.arange(3))
    (model.parent / "broken.of_0123456789ab.npz").write_bytes(b"no archive")
    assert undo(model) is None
    assert {"other.npz", "broken.of_0123456789ab.npz"} <= set(bytes_of(model.parent))
    with pytest.raises(InputError):
        predictor_file.load(model.parent / "other.npz")


def test_a_predictor_of_any_other_model_is_kept_where_apply_says(
    diagnosed: Callable[..., Path], tmp_path: Path
) -> None:
    """Put there by hand, it is of no version that `undo` knows: its only copy was deleted."""
    model = at_work(tmp_path)
    apply(diagnosed("first"), ARM, model)
    others = (model.parent / "predictor.npz").read_bytes()
    wider = diagnosed("second", before=model, model=FOUND.with_values(1.5 * FOUND.values))
    apply(wider, ARM, model)
    more = FOUND.with_values(1.7 * FOUND.values)
    for name in ("third", "fourth"):
        (model.parent / "predictor.npz").write_bytes(others)
        done = apply(diagnosed(name, before=model, model=more), ARM, model)
        more = FOUND.with_values(1.9 * FOUND.values)
        assert done.set_aside is not None and done.set_aside.read_bytes() == others


def test_two_changes_at_once_are_refused(
    diagnosed: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The slower one would replace what the quicker one put to work, and its model before."""
    model = at_work(tmp_path)
    first = apply(diagnosed("first"), ARM, model, network=False)
    kept = model.read_bytes()
    wider = FOUND.with_values(1.5 * FOUND.values)
    second, rival = (diagnosed(n, before=model, model=wider, seed=n) for n in ("second", "rival"))

    def meanwhile(*given: Any, **named: Any) -> TrainedPredictor:
        for change in (lambda: apply(rival, ARM, model, network=False), lambda: undo(model)):
            with pytest.raises(InputError, match="in use by another process"):
                change()
        return small_networks()(*given, **named)

    monkeypatch.setattr("longarm_comp.workflows.apply.train", meanwhile)
    apply(second, ARM, model)
    assert model.read_bytes() == (second / "model.yaml").read_bytes()
    undo(model)
    assert model.read_bytes() == kept
    assert first.model == model


def test_files_of_two_diagnoses_are_refused(diagnosed: Callable[..., Path], tmp_path: Path) -> None:
    """A diagnosis that is broken off while it writes leaves the model of the one before it."""
    folder = diagnosed()
    report = folder / "report.json"
    text = report.read_text()
    written = record.read_report(folder).provenance.data_sha256
    report.write_text(text.replace(written, 64 * "0"))
    with pytest.raises(InputError, match="files of one diagnosis"):
        apply(folder, ARM, at_work(tmp_path))
    assert not at_work(tmp_path).exists()
