"""Files of predictors: what is saved comes back, what is damaged is refused by name."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT
from quick_predictor import ORIGIN

from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.predictor_file import load, save

SAVED = """
import sys
import numpy as np
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor_file import save
rng = np.random.default_rng(0)
q = rng.uniform(-0.5, 0.5, (300, 7))
seen = 3e-3 * q[:, :3] + 4e-4 * rng.standard_normal((300, 3))
quick = {"hidden": 15, "ensemble": 1, "iterations": 5, "population": 10}
save(train(q, seen, seed=2, **quick), sys.argv[1])
"""


def test_a_saved_predictor_comes_back_the_same(data, small, tmp_path):
    predictor, _ = small
    path = tmp_path / "predictor.npz"
    save(predictor, path)
    back = load(path, arm_hash="arm-1", joint_names=ORIGIN.joint_names)
    before, after = predictor.predict(data.test_q), back.predict(data.test_q)
    np.testing.assert_array_equal(before.error, after.error)
    np.testing.assert_array_equal(before.sigma, after.sigma)
    np.testing.assert_array_equal(before.in_domain, after.in_domain)
    np.testing.assert_array_equal(back.alone, predictor.alone)
    assert back.provenance.settings["samples"] == 300
    assert back.provenance.session_hash == "session-1"
    first = path.read_bytes()
    save(back, path)
    assert path.read_bytes() == first


def test_prediction_needs_numpy_alone(small, tmp_path):
    predictor, _ = small
    save(predictor, tmp_path / "p.npz")
    code = (
        "import sys, numpy as np; from longarm_comp.core.learn.predictor_file import load;"
        f"load({str(tmp_path / 'p.npz')!r}).predict(np.zeros((1, 7)));"
        "sys.exit('sklearn' in sys.modules or 'scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_same_seed_gives_the_same_bytes_in_every_process(tmp_path, monkeypatch):
    """Whatever number of threads the process has: this one has one."""
    here, there = tmp_path / "here.npz", tmp_path / "there.npz"
    env = {**os.environ, "OMP_NUM_THREADS": "2", "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", SAVED, str(there)], env=env, check=True)
    monkeypatch.setattr(sys, "argv", ["", str(here)])
    exec(SAVED, {})
    assert here.read_bytes() == there.read_bytes()


@pytest.mark.parametrize("keep", [0, 10, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused_by_name(small, tmp_path, keep):
    path = tmp_path / "cut.npz"
    save(small[0], path)
    whole = path.read_bytes()
    path.write_bytes(whole[: keep if isinstance(keep, int) else int(keep * len(whole))])
    with pytest.raises(InputError) as caught:
        load(path)
    assert "cut.npz" in str(caught.value)


def test_flipped_bytes_never_get_through(small, tmp_path):
    path = tmp_path / "flip.npz"
    save(small[0], path)
    whole = path.read_bytes()
    truth = load(path).predict(np.zeros((1, 7))).error
    for at in np.random.default_rng(8).integers(0, len(whole), 60):
        broken = bytearray(whole)
        broken[at] ^= 0xFF
        path.write_bytes(bytes(broken))
        try:
            found = load(path).predict(np.zeros((1, 7))).error
        except InputError:
            continue
        np.testing.assert_array_equal(found, truth)  # padding or a time stamp


def rewrite(path, change):
    with np.load(path) as data:
        arrays = dict(data)
    header = json.loads(arrays["header"].tobytes())
    change(header, arrays)
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda h, a: h.update(version=99), "version"),
        (lambda h, a: h.update(format="something"), "format"),
        (lambda h, a: h.update(scale=float("nan")), "scale"),
        (lambda h, a: h.update(hidden=7), "weights"),
        (lambda h, a: h.update(hidden="six"), "hidden"),
        (lambda h, a: h.update(joints=10**9), "joints"),
        (lambda h, a: h.update(context=["moon_phase"]), "context.0"),
        (lambda h, a: h.pop("variance_limit"), "variance_limit"),
        (lambda h, a: a.pop("weights"), "weights"),
        (lambda h, a: a.update(weights=a["weights"][:, :-1]), "weights"),
        (lambda h, a: a.update(mean=a["mean"] * np.nan), "mean"),
        (lambda h, a: a.update(kept=a["kept"] + 1000), "kept"),
        (lambda h, a: a.update(offset=np.array(["a", "b", "c"])), "offset"),
        (lambda h, a: a.update(alone=np.array([1e-3, np.nan, 1e-3])), "alone"),
        (lambda h, a: a.update(alone=np.array([1e-3, -1e-3, 1e-3])), "alone"),
        (lambda h, a: a.pop("gain"), "gain"),
    ],
)
def test_a_wrong_field_is_named(small, tmp_path, change, field):
    path = tmp_path / "wrong.npz"
    save(small[0], path)
    rewrite(path, change)
    with pytest.raises(InputError) as caught:
        load(path)
    assert caught.value.field == field


def test_a_pickle_is_never_loaded(tmp_path):
    path = tmp_path / "evil.npz"
    np.savez(path, header=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError):
        load(path)


@pytest.mark.parametrize("wanted", [{"arm_hash": "arm-2"}, {"joint_names": ("a", "b")}])
def test_another_arm_is_refused(small, tmp_path, wanted):
    save(small[0], tmp_path / "p.npz")
    with pytest.raises(InputError) as caught:
        load(tmp_path / "p.npz", **wanted)
    assert caught.value.field in wanted


def test_a_missing_file_and_an_unwritable_folder_are_named(small, tmp_path):
    with pytest.raises(InputError):
        load(tmp_path / "none.npz")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError):
        save(small[0], tmp_path / "file" / "p.npz")
