"""Files that could be read in two ways, would not end, or hold what no machine has: refused."""

import io
import os
import resource
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cli_shell import Shell
from loaded_arm import arm_data
from openpyxl import Workbook
from small_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.files import atomic_path
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.engines import Engine
from longarm_comp.core.learn.predictor_file import load
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, read_stored, save_model, store
from longarm_comp.devices.servo_config import ServoConfig


@pytest.mark.parametrize(
    ("keys", "value", "said"),
    [
        (("links", 0, "mass_kg"), True, "links.0.mass_kg: True; allowed: a number"),
        (("tip", "position_m"), [0, True, 0], "tip.position_m.1: True"),
        (("joints", 0, "id"), True, "joints.0.id: True"),
        (("gravity_mps2",), [0, 0, -9810], "gravity_mps2.2: -9810.0; allowed: -50 to 50"),
        (("links", 0, "E_pa"), 5e-324, "links.0.E_pa: 5e-324; allowed: 1e+06"),
        (("links", 0, "section", "od_m"), 1e7, "links.0.section.tube.od_m: 10000000.0"),
        (("payload", "mass_kg"), 1e9, "payload.mass_kg: 1000000000.0"),
        (("joints", 0, "limits_deg"), [0, 1e9], "joints.0.limits_deg.1: 1000000000.0"),
        (("reference_temperature_c",), -300, "reference_temperature_c: -300.0"),
    ],
)
def test_arms_that_no_machine_is(keys: tuple[str | int, ...], value: object, said: str) -> None:
    data = node = arm_data()
    for key in keys[:-1]:
        node = node[key]  # type: ignore[index]
    Arm.parse(data, "arm.yaml")
    node[keys[-1]] = value  # type: ignore[index]
    with pytest.raises(InputError) as caught:
        Arm.parse(data, "arm.yaml")
    assert said.replace(".tube", "") in str(caught.value).replace(".tube", "")


def test_a_section_without_stiffness_is_refused() -> None:
    data = arm_data()
    data["links"][0]["section"] = {"type": "tube", "od_m": 1e-5}
    with pytest.raises(InputError, match=r"links\.0\.section"):
        Arm.parse(data, "arm.yaml")


ABSURD = {
    "base_high": {"joints": (0, "d_m", 999_999.0)},
    "heavy": {"payload": ("mass_kg", 9999.0)},
    "long": {"joints": (2, "d_m", 1000.0)},
}


@pytest.mark.parametrize(
    ("change", "engine"),
    [
        pytest.param(
            change, engine, id=f"{name}-{engine.name}",
            marks=[pytest.mark.long] * (engine is Engine.COMPILED and name != "heavy"),
        )
        for name, change in ABSURD.items()
        for engine in (Engine.MODEL, Engine.COMPILED)
    ],
)  # fmt: skip
def test_an_absurd_arm_reaches_nothing_on_any_engine(
    change: dict[str, tuple[Any, ...]], engine: Engine
) -> None:
    data = arm_data()
    data["links"][0] |= {"section": {"type": "tube", "od_m": 2e-3}}
    for key, (*path, value) in change.items():
        node = data[key]
        for part in path[:-1]:
            node = node[part]
        node[path[-1]] = value
    model = declared_model(Arm.parse(data, "arm.yaml"))
    with np.errstate(all="ignore"):
        found = ik.solve_many(model, np.array([[0.5, 0.0, 0.3]]), engine=engine)
    assert not found.ok.any()


def test_a_target_that_bends_the_arm_without_bound_says_so(work: Path, shell: Shell) -> None:
    data = arm_data()
    data["links"][0] |= {"section": {"type": "tube", "od_m": 2e-3}}
    data["payload"]["most_kg"] = 1e4
    Path("weak.yaml").write_text(yaml.safe_dump(data))
    Path("t.csv").write_text("x,y,z,payload_kg\n0.5,0,0.3,9999\n")
    line = shell.refused("compensate", "weak.yaml", "--targets", "t.csv", code=3)
    assert "unreachable" in line and len(line) < 300


@pytest.mark.parametrize(
    ("header", "row", "said"),
    [
        ("x,y,z,payload_kg", "0.5,0,0.2,-5", "line 2, payload_kg: '-5'"),
        ("x,y,z,temperature_c", "0.5,0,0.2,1e300", "line 2, temperature_c: '1e300'"),
        ("x,y,z,t_s", "0.5,0,0.2,1e300", "line 2, t_s: '1e300'"),
        ("x,y,z,index", "0.5,0,0.2,1e300", "line 2, index: '1e300'"),
        ("x,y,z", "1e200,0,0.2", "line 2, x: '1e200'"),
        ("x,y,z,qx,qy,qz,qw", "0.5,0,0.2,1e200,0,0,0", "line 2, qx: '1e200'"),
    ],
)
def test_targets_in_no_world(
    header: str, row: str, said: str, work: Path, shell: Shell
) -> None:  # fmt: skip
    Path("t.csv").write_text(f"{header}\n{row}\n")
    assert said in shell.refused("compensate", work / "arm.yaml", "--targets", "t.csv")


def test_payload_below_nothing_in_a_session(work: Path, shell: Shell) -> None:
    lines = (work / "test.csv").read_text().splitlines()
    made = [lines[0] + ",payload_kg", *(line + ",-5" for line in lines[1:])]
    Path("bad.csv").write_text("\n".join(made))
    line = shell.refused("evaluate", work / "arm.yaml", "--test", "bad.csv")
    assert "line 2, payload_kg: '-5'" in line


# ------------------------------------------------------------------ model.yaml


def stored(work: Path) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load((work / "model.yaml").read_text())
    return data


def check(data: dict[str, Any], said: str) -> None:
    Path("m.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(InputError) as caught:
        load_model("m.yaml", ARM)
    assert said in str(caught.value)


def test_models_that_are_refused(work: Path, shell: Shell) -> None:
    load_model(work / "model.yaml", ARM)
    data = stored(work)
    check(data | {"passes": 100_000}, "passes: 100000")
    check(data | {"elements_per_beam": 5000}, "elements_per_beam: 5000")
    zero = next(t for t in data["geometry"] if t["effect"] == "joint_zero")
    check(data | {"geometry": [*data["geometry"], zero, zero]}, f"joint_zero, {zero['where']}: 'tw")
    joint = {**zero, "form": {"joint": float(zero["form"]["joint"])}}
    others = [t for t in data["geometry"] if t is not zero]
    check(data | {"geometry": [*others, joint]}, "joint_zero.joint: ")
    (name, value), *_ = zero["parameters"].items()
    low, high = value["ci95"]
    wrong = {**zero, "parameters": {name: {**value, "ci95": [high, low]}}}
    check(data | {"geometry": [*others, wrong]}, "ci95: ")
    true = {**zero, "parameters": {name: {**value, "value": True}}}
    check(data | {"geometry": [*others, true]}, "value: True")


def test_undo_takes_no_rubbish(work: Path, shell: Shell, rng: np.random.Generator) -> None:
    Path("m.yaml").write_bytes((work / "model.yaml").read_bytes())
    Path("m.previous.yaml").write_bytes(rng.bytes(100))
    assert "m.previous.yaml" in shell.refused("undo", "m.yaml")
    read_stored("m.yaml")
    assert Path("m.previous.yaml").exists()


def test_undo_of_a_folder(shell: Shell) -> None:
    assert ".: model: 'a folder'" in shell.refused("undo", ".")


def test_servo_files_are_read_strictly(tmp_path: Path) -> None:
    path = tmp_path / "servo.yaml"
    joint = (
        "servo_id: 1, model: sts3215, type: revolute, zero_ticks: 2048, upper: 1, max_velocity: 1"
    )
    for bad, said in (
        (f"{{{joint}, lower: -01}}", "joints.j.lower"),
        (f"{{{joint}, lower: true}}", "joints.j.lower: True"),
        (f"{{{joint}, lower: -1, lower: 0}}", "joints.j.lower: 'twice"),
    ):
        path.write_text(f"bus: {{protocol: feetech, port: /dev/null}}\njoints:\n  j: {bad}\n")
        with pytest.raises(InputError) as caught:
            ServoConfig.load(path)
        assert said in str(caught.value)


# ------------------------------------------------------------------ predictor files


def with_member(source: Path, name: str, data: bytes | None) -> bytes:
    """The archive with one member replaced, or a hole of 300 MB in its place."""
    made = io.BytesIO()
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.infolist():
            if entry.filename != name:
                new.writestr(entry.filename, old.read(entry))
            elif data is not None:
                new.writestr(entry.filename, data)
            else:
                with new.open(entry.filename, "w") as member:
                    for _ in range(300):
                        member.write(bytes(1_000_000))
    return made.getvalue()


def test_a_workbook_that_unpacks_to_more_than_any_table_is_refused(shell: Shell) -> None:
    book = Workbook()
    book.active.append(("q1", "x", "y", "z"))
    book.active.append((1.0, 2.0, 3.0, 4.0))
    book.save("log.xlsx")
    Path("bomb.xlsx").write_bytes(with_member(Path("log.xlsx"), "docProps/core.xml", None))
    assert "unpacked size" in shell.refused("import-data", "bomb.xlsx", "-o", "s.csv")


def npy_header(shape: str) -> bytes:
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def test_predictors_that_are_refused(work: Path, shell: Shell) -> None:
    evaluate = ("evaluate", work / "arm.yaml", "--test", work / "test.csv", "--model",
                work / "model.yaml", "--predictor", "p.npz")  # fmt: skip
    source = work / "predictor.npz"
    Path("p.npz").write_bytes(with_member(source, "weights.npy", None))
    assert Path("p.npz").stat().st_size < 1_000_000
    assert "unpacked size" in shell.refused(*evaluate)
    for shape in ("(1000000000000, 9)", "(-3,)", "(2, 3", "(999999999999999999999999,)"):
        Path("p.npz").write_bytes(with_member(source, "weights.npy", npy_header(shape)))
        with pytest.raises(InputError, match=r"p\.npz: predictor file: "):
            load(Path("p.npz"))
    Path("p.npz").write_bytes(with_member(source, "header.npy", b"[" * 100_000))
    shell.refused(*evaluate)
    good = bytearray(with_member(source, "none", None))
    for at in range(60, len(good) - 2000, 37):
        good[at] ^= 0x55
    Path("p.npz").write_bytes(good)
    assert "p.npz: " in shell.refused(*evaluate)


# ------------------------------------------------------------------ the machine


def test_a_full_disk_is_one_line(work: Path, tmp_path: Path) -> None:
    """A limit on the size of files stands for the full disk: writing fails in the same places."""
    words = ("calibrate", work / "arm.yaml", work / "samples.csv", "-o", "made")
    done = subprocess.run(
        [sys.executable, "-m", "longarm_comp", *map(str, words)],
        cwd=tmp_path,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3, done.stderr
    assert done.stderr == "longarm: made was not written: File too large\n"
    assert os.listdir(tmp_path) == []


def test_a_writer_that_meets_a_broken_disk(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="No space"), atomic_path(tmp_path / "a.yaml"):
        raise OSError(28, "No space left on device")
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "a.yaml"):
        (tmp_path / "none").read_text()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(13, "Permission denied", "/some/file"), "/some/file: Permission denied"),
        (MemoryError(), "not enough memory"),
        (RecursionError(), "nested too deeply"),
    ],
)
def test_what_the_machine_refuses_is_one_line(
    error: Exception, said: str, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path) -> None:
        raise error

    monkeypatch.setattr("longarm_comp.core.model.model_file.undo", fail)
    line = shell.refused("undo", "m.yaml", code=3)
    assert said in line


def test_a_model_file_survives_its_own_round(tmp_path: Path) -> None:
    data = arm_data()
    arm = Arm.parse(data, "arm.yaml")
    save_model(tmp_path / "m.yaml", store(declared_model(arm)))
    assert repr(load_model(tmp_path / "m.yaml", arm)) == repr(declared_model(arm))
    assert Model(arm).arm.n == 4
