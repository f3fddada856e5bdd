"""Networks of others: a file or a package; trained, judged, saved, served; and refused."""

import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cli_shell import Shell
from page_lines import lines
from places import ROOT
from quick_predictor import quick_predictor, rows

from bench.smooth import rms_mm
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn import others
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.learn.predictor_file import load, save

TWO_LAYERS = ROOT / "examples" / "two_layers.py"
SMALL = """
import torch


def network(inputs, outputs):
    return torch.nn.Sequential(
        torch.nn.Linear(inputs, 5), torch.nn.Tanh(), torch.nn.Linear(5, outputs)
    )
"""


@pytest.fixture(autouse=True)
def no_network_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(others, "_loaded", {})


@pytest.fixture(name="small")
def small_(tmp_path: Path) -> Path:
    path = tmp_path / "small.py"
    path.write_text(SMALL)
    return path


def trained(path: Path) -> Predictor:
    return train(rows().q, rows().residual, network=others.load_file(path), ensemble=2)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Predictor:
    """What the small network has learned, once for those tests that ask nothing of its training."""
    path = tmp_path_factory.mktemp("network") / "small.py"
    path.write_text(SMALL)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(others, "_loaded", {})
        return trained(path)


@pytest.fixture(name="learned")
def learned_(made: Predictor, small: Path) -> Predictor:
    """The same, where the file that defines its network was given."""
    others.load_file(small)
    return made


def test_it_learns_is_honest_and_comes_back_from_its_file(
    learned: Predictor, small: Path, tmp_path: Path
) -> None:
    predictor, file = learned, tmp_path / "predictor.safetensors"
    found = predictor.predict(rows().test_q)
    assert predictor.gain.helps
    assert rms_mm(found.error - rows().test_truth) < 0.5  # of 2 to 3 mm
    inside = np.abs(rows().test_residual - found.error) < 1.645 * found.sigma
    assert 0.85 < inside.mean() < 0.99
    assert not predictor.predict(2.0 * rows().q[:1]).in_domain[0]
    again = trained(small)
    np.testing.assert_array_equal(predictor.weights, again.weights)
    save(predictor, file)
    back, written = load(file), file.read_bytes()
    for _ in range(8):
        save(back, file)
        assert file.read_bytes() == written
    assert back.network == predictor.network
    np.testing.assert_array_equal(back.predict(rows().test_q).sigma, found.sigma)
    np.testing.assert_array_equal(back.predict(rows().test_q).error, found.error)


def test_the_slope_is_that_of_the_prediction_and_is_not_carried_on(learned: Predictor) -> None:
    predictor = learned
    for q in rows().q[:3]:
        expansion, h = predictor.expand(q), 1e-6
        seen = predictor.predict(np.concatenate([q + h * np.eye(7), q - h * np.eye(7)])).error
        numeric = (seen[:7] - seen[7:]).T / (2.0 * h)
        np.testing.assert_allclose(expansion.jacobian, numeric, rtol=1e-5, atol=1e-9)
        assert not expansion.reach.any()


def test_noise_alone_is_not_admitted(small: Path) -> None:
    rng = np.random.default_rng(0)
    noise = 1e-3 * rng.standard_normal((80, 3))
    found = train(rows().q[:80], noise, network=others.load_file(small), ensemble=2)
    assert not found.gain.helps


def test_an_edited_or_unknown_network_is_refused(
    learned: Predictor, small: Path, tmp_path: Path
) -> None:
    predictor, file = learned, tmp_path / "predictor.safetensors"
    save(predictor, file)
    others._loaded.clear()
    with pytest.raises(InputError, match=r"not known.*give it with --network"):
        load(file)
    small.write_text(SMALL.replace("Tanh", "Sigmoid"))
    others.load_file(small)
    with pytest.raises(InputError, match=r"small.*now of another file"):
        load(file)
    small.write_text(SMALL)
    others.load_file(small)
    load(file)


def test_a_predictor_that_names_a_file_executes_nothing(learned: Predictor, tmp_path: Path) -> None:
    predictor, file = learned, tmp_path / "predictor.safetensors"
    evil = tmp_path / "evil.py"
    evil.write_text(f"import pathlib\npathlib.Path({str(tmp_path / 'executed')!r}).touch()\n")
    assert predictor.network is not None
    save(replace(predictor, network=replace(predictor.network, name=str(evil))), file)
    with pytest.raises(InputError, match=r"not known.*give it with --network"):
        load(file)
    assert not (tmp_path / "executed").exists()


def test_damaged_files_never_get_through(learned: Predictor, tmp_path: Path) -> None:
    predictor, file = learned, tmp_path / "predictor.safetensors"
    save(predictor, file)
    whole, truth = file.read_bytes(), predictor.predict(rows().q[:1]).error
    for at in np.random.default_rng(8).integers(0, len(whole), 40):
        broken = bytearray(whole)
        broken[at] ^= 0xFF
        file.write_bytes(bytes(broken))
        try:
            found = load(file).predict(rows().q[:1]).error
        except InputError:
            continue
        np.testing.assert_array_equal(found, truth)  # padding of the header
    for cut in (0, 5, len(whole) // 2):
        file.write_bytes(whole[:cut])
        with pytest.raises(InputError, match=r"predictor\.safetensors"):
            load(file)


def test_the_ending_says_which_network_it_is(learned: Predictor, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.safetensors for a network of others"):
        save(learned, tmp_path / "predictor.npz")
    own, _ = quick_predictor()
    with pytest.raises(InputError, match=r"\.npz for the paper's"):
        save(own, tmp_path / "predictor.safetensors")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = 1", "a function network"),
        ("1 / 0", "ZeroDivisionError"),
        (SMALL.replace("5, outputs", "5, 2"), r"shape \(3, 2\)"),
        (SMALL.replace("(5, outputs)", "(6, outputs)"), "RuntimeError"),
        (SMALL.replace("torch.nn.Tanh()", "torch.nn.BatchNorm1d(5)"), "buffers"),
        ("import torch\nnetwork = lambda inputs, outputs: torch.nn.Flatten()", "shape"),
    ],
)
def test_what_cannot_be_trained_is_refused(small: Path, text: str, said: str) -> None:
    small.write_text(text)
    with pytest.raises(InputError, match=said):
        trained(small)


@pytest.mark.parametrize("how", [{"hidden": 5}, {"init": "xavier"}])
def test_settings_of_the_papers_network_are_refused(small: Path, how: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="small has its own"):
        train(rows().q, rows().residual, network=others.load_file(small), **how)


def test_a_network_of_a_package_is_found_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def factory(inputs: int, outputs: int) -> torch.nn.Module:
        return torch.nn.Linear(inputs, outputs)

    found = [("linear", factory, "package lines 1.0, entry point linear")]
    monkeypatch.setattr(others, "of_other_packages", lambda group: found)
    others._of_packages.cache_clear()
    try:
        kind = others.choose_network("linear")
        assert (kind.name, kind.origin) == ("linear", "package lines 1.0, entry point linear")
        with pytest.raises(InputError, match=r"lines, a Python file|linear, a Python file"):
            others.choose_network("curves")
    finally:
        others._of_packages.cache_clear()


def test_a_device_that_is_not_there_is_refused_and_auto_is_the_cpu_then() -> None:
    if torch.cuda.is_available():
        pytest.skip("a GPU is there")
    quick = {"hidden": 3, "ensemble": 1, "iterations": 3, "population": 8}
    one, other = (train(rows().q, rows().residual, device=d, **quick) for d in ("auto", "cpu"))
    np.testing.assert_array_equal(one.weights, other.weights)
    for device in ("cuda", "abacus"):
        with pytest.raises(InputError, match="device"):
            train(rows().q, rows().residual, device=device, **quick)


def test_training_takes_the_threads_of_others_only_for_a_while() -> None:
    before = torch.get_num_threads()
    train(rows().q, rows().residual, hidden=2, ensemble=1, init="xavier")
    assert torch.get_num_threads() == before


@pytest.mark.long
def test_the_page_runs_as_it_is_written(shell: Shell) -> None:
    """docs/your_own_network.md, with one network instead of five."""
    for words in lines("docs/your_own_network.md"):
        words = [str(ROOT / w) if w.startswith("examples/") else w for w in words]
        if words[0] == "python" and words[1] != "-m":
            env = {**os.environ, "PYTHONPATH": str(ROOT)}
            subprocess.run([sys.executable, *words[1:]], env=env, check=True)
        elif words[1] in ("train", "evaluate"):
            more = ["--ensemble", "1"] if words[1] == "train" else []
            assert shell(*words[1:], *more) == 0, f"{shlex.join(words)}\n{shell.err}"
    rows = [line for line in shell.out.splitlines() if "│" in line]
    mean = {row.split("│")[1].strip(): float(row.split("│")[3]) for row in rows}
    assert mean["network"] < 0.5 * mean["deflection"], mean
