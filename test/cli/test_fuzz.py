"""Damaged files given to every command that reads one: an answer or one line, never a traceback.

``make fuzz`` runs 3,000 of them; the ordinary tests 60.
"""

import csv
import math
import os
import shutil
import signal
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import report_samples
import yaml
from bag_robot import asked, command, robot, sighting, state
from cli_shell import Shell
from damage import damaged
from openpyxl import Workbook
from places import EXAMPLES
from session_bag import write_bag
from small_arm import ARM, measured

from longarm_comp.arm_folder.measured import SIDES
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.files import write_text
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.stereo.camera_file import camera_text
from longarm_comp.report import record
from longarm_comp.report.record import read_report
from longarm_comp.sessions.csv import read_csv, write_csv
from longarm_comp.sim.cameras import CameraPair
from longarm_comp.sim.servo_emulator.joints import read_arm

pytestmark = pytest.mark.usefixtures("few_names_here")
RUNS = int(os.environ.get("LONGARM_FUZZ_RUNS", "60"))
PARTS = 10
HANG_S = 120

ARM_FILE, MODEL, PREDICTOR = "arm.yaml", "model.yaml", "predictor.npz"
TOUCHED = EXAMPLES / "panda_touch"
BENDING = {
    **ARM.model_dump(mode="json", exclude_defaults=True),
    "base": {"xyz_m": [0.0, 0.0, 0.0], "rpy_deg": [0.0, 0.0, 0.0]},
    "payload": {"frame": 4, "position_m": [0.0, 0.0, 0.05], "mass_kg": 0.05},
    "links": [
        {"name": "boom", "row": 3, "role": "d", "length_m": "rest", "E_pa": 70e9, "poisson": 0.33,
         "section": {"type": "tube", "od_m": 0.05, "id_m": 0.044}, "mass_kg": 0.4,
         "body_length_m": 0.4},
        {"name": "tool", "row": 4, "role": "a", "length_m": 0.1, "EI_nm2": 900.0, "GJ_nm2": 700.0},
    ],
    "point_masses": [{"name": "servo", "frame": 3, "mass_kg": 0.1}],
    "camera": {"position_m": [0.0, -1.0, 0.3]},
    "markers": {"far": {"frame": 4, "position_m": [0.0, 0.0, 0.1]}},
}  # fmt: skip
LIFT = """<robot name="lift">
  <link name="base"/>
  <link name="a"><inertial><origin xyz="0.1 0 0.02"/><mass value="1.5"/></inertial></link>
  <link name="b"/>
  <joint name="ja" type="prismatic"><parent link="base"/><child link="a"/>
    <origin xyz="0 0 0.3" rpy="0 1.57 0"/><axis xyz="0 -1 0"/>
    <limit lower="-0.1" upper="0.4" effort="1" velocity="1"/></joint>
  <joint name="jb" type="revolute"><parent link="a"/><child link="b"/>
    <axis xyz="1 1 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
</robot>
"""


@dataclass(frozen=True)
class Reading:
    """A command and the files of the folder that it reads, of which one is damaged."""

    words: tuple[str, ...]
    reads: tuple[str, ...]


STIFF, KNOWN = "stiff.yaml", "known.yaml"
FOLDER, MAPPING = "my_arm", "log.mapping.yaml"
FILES = tuple(
    f"{FOLDER}/{name}.yaml" for name in ("arm", "servo_driver", "stereo_bridge", "simulated_arm")
)
CAMERAS = tuple(f"{FOLDER}/cameras/{side}.yaml" for side in SIDES)
WITH_MODEL = ("--model", MODEL, "--predictor", PREDICTOR)
KIND = (MODEL, "kept.yaml", "third.yaml")
READINGS = (
    Reading(("evaluate", ARM_FILE, "--test", "few.csv"), (ARM_FILE, "few.csv")),
    Reading(("evaluate", ARM_FILE, "--test", "few.csv", *WITH_MODEL), (MODEL, PREDICTOR)),
    Reading(("compensate", ARM_FILE, "--targets", "targets.csv"), (ARM_FILE, "targets.csv")),
    Reading(
        ("compensate", ARM_FILE, "--targets", "targets.csv", *WITH_MODEL),
        (MODEL, PREDICTOR, "targets.csv"),
    ),
    Reading(
        ("compensate", ARM_FILE, "--targets", "targets.csv", "--history", "few.csv"),
        ("few.csv", ARM_FILE),
    ),
    Reading(("plan", ARM_FILE, "--kind", "sobol", "-n", "3", "-o", "p.csv"), (ARM_FILE,)),
    Reading(("calibrate", ARM_FILE, "few.csv", "-o", "fitted.yaml"), ("few.csv", ARM_FILE)),
    Reading(
        ("train", ARM_FILE, "few.csv", "--ensemble", "1", "--hidden", "2", "-o", "p.npz"),
        ("few.csv",),
    ),
    Reading(
        ("diagnose", STIFF, "few.csv", "--model", KNOWN, "--no-network", "-o", "found"),
        ("few.csv", STIFF, KNOWN),
    ),
    Reading(
        ("bag", "to-csv", ARM_FILE, "bag", "-o", "b.csv"), ("bag/metadata.yaml", "bag/bag.mcap")
    ),
    Reading(
        ("plan", ARM_FILE, "--kind", "next", "--report", ".", "-n", "2", "-o", "p.csv"),
        ("next_poses.csv", ARM_FILE),
    ),
    Reading(("bag", "info", "bag"), ("bag/metadata.yaml", "bag/bag.mcap")),
    Reading(("evaluate", ARM_FILE, "--test", "bag"), ("bag/metadata.yaml", "bag/bag.mcap")),
    Reading(("export-urdf", ARM_FILE, "--model", MODEL), (ARM_FILE, MODEL)),
    Reading(("import-data", "log.csv", "-o", "s.csv"), ("log.csv",)),
    Reading(("import-data", "log.xlsx", "--units", "mm,deg", "-o", "s.csv"), ("log.xlsx",)),
    Reading(("undo", "kept.yaml"), ("kept.previous.yaml",)),
    Reading(
        ("init", "l", "--urdf", "lift.urdf", "--base", "base", "--tip", "b", "--only-arm"),
        ("lift.urdf",),
    ),
    Reading(("import-data", "log.csv", "--like", MAPPING, "-o", "s.csv"), (MAPPING,)),
    Reading(
        ("plan", ARM_FILE, "--kind", "sobol", "-n", "3", "--like", MAPPING, "-o", "p.csv"),
        (MAPPING,),
    ),
    Reading(("init", "new", "--arm", ARM_FILE), (ARM_FILE,)),
    Reading(("init", "newer", "--urdf", "lift.urdf"), ("lift.urdf",)),
    Reading(("check", FOLDER), (*FILES, *CAMERAS)),
    Reading(("modes", ARM_FILE, "--at", "next_poses.csv", "--model", MODEL),
            ("next_poses.csv", MODEL, ARM_FILE)),
    Reading(("compensate", ARM_FILE, "--path", "path.csv", "--model", MODEL, "-o", "way.csv"),
            ("path.csv", MODEL)),
    Reading(("import-data", "log.csv", "beside.csv", "--join", "Time", "-o", "s.csv"),
            ("log.csv", "beside.csv")),
    Reading(("fleet", "arms", "--no-network", "-o", "fleet"), ("arms/a/arm.yaml", "arms/a/s.csv")),
    Reading(("stereo", "marker", FOLDER, "-o", "page.pdf"), (f"{FOLDER}/stereo_bridge.yaml",)),
    Reading(("stereo", "hand-eye", FOLDER, "few.csv"), (*FILES, "few.csv")),
    Reading(("collect", ARM_FILE, "next_poses.csv", "--dry-run"), ("next_poses.csv", ARM_FILE)),
    Reading(("day-report", ARM_FILE, "day"), ("day/metadata.yaml", "day/day.mcap", ARM_FILE)),
    Reading(("compensate", ARM_FILE, "--targets", "targets.csv", "--like", MAPPING, "-o", "l.csv"),
            (MAPPING, "targets.csv")),
    Reading(("calibrate", ARM_FILE, "few.csv", "-o", "kind.yaml", "--kind-of", *KIND),
            (MODEL,)),
    Reading(("calibrate", "ball.yaml", "touched.csv", "-o", "held.yaml"),
            ("touched.csv", "touches.yaml")),
)  # fmt: skip


@pytest.fixture(scope="module")
def whole(work: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which every command of `READINGS` works."""
    folder = tmp_path_factory.mktemp("whole")
    made = Shell(folder)
    (folder / ARM_FILE).write_text(yaml.safe_dump(BENDING))
    arm, samples, model = folder / ARM_FILE, work / "samples.csv", folder / MODEL
    assert made("calibrate", arm, samples, "-o", model, "--effect", "joint_compliance") == 0
    quick = ("--ensemble", 1, "--hidden", 3)
    assert made("train", arm, samples, "--model", model, "-o", folder / PREDICTOR, *quick) == 0
    for copy in KIND[1:]:
        shutil.copy(model, folder / copy)
    shutil.copy(model, folder / "kept.previous.yaml")
    few = folder / "few.csv"
    write_csv(measured(25, np.random.default_rng(2)), few)
    (folder / STIFF).write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_defaults=True)))
    assert made("calibrate", folder / STIFF, few, "-o", folder / KNOWN) == 0
    aims = Model(ARM).tip(ARM.lower + np.array([[0.4], [0.6]]) * (ARM.upper - ARM.lower))
    lines = ["x,y,z,payload_kg,temperature_c,t_s,approach"]
    lines += [f"{x:.4f},{y:.4f},{z:.4f},0.0,20.5,12," for x, y, z in aims]
    (folder / "targets.csv").write_text("\n".join(lines) + "\n")
    way = Model(ARM).tip(ARM.lower + np.linspace(0.4, 0.45, 4)[:, None] * (ARM.upper - ARM.lower))
    (folder / "path.csv").write_text(
        "t_s,x,y,z\n" + "".join(f"{k},{x:.5f},{y:.5f},{z:.5f}\n" for k, (x, y, z) in enumerate(way))
    )
    (folder / "beside.csv").write_text("Time [s];Temp [C]\n1,5;20\n2,5;21\n")
    sheet = "Time [s];A1 [deg];A2 [deg];A3 [mm];A4 [deg];X [mm];Y [mm];Z [mm]\n"
    sheet += "1,5;2,5;3;50;1;4;5;6\n2,5;2,5;3;60;1;;;\n"
    (folder / "log.csv").write_text(sheet)
    assert made("import-data", folder / "log.csv", "-o", folder / "log_samples.csv") == 0
    (folder / "log_samples.mapping.yaml").rename(folder / MAPPING)
    seen = folder / "without_camera.yaml"
    seen.write_text(yaml.safe_dump({k: v for k, v in BENDING.items() if k != "camera"}))
    assert made("init", folder / FOLDER, "--arm", seen) == 0
    pair = CameraPair((0.2, -2.0, 0.3), (0.0, 1.0, 0.0))
    for side, info in zip(SIDES, pair.camera_infos(), strict=True):
        write_text(folder / FOLDER / "cameras" / f"{side}.yaml", camera_text(side, info))
    (folder / "arms" / "a").mkdir(parents=True)
    shutil.copy(folder / STIFF, folder / "arms" / "a" / "arm.yaml")
    shutil.copy(folder / "few.csv", folder / "arms" / "a" / "s.csv")
    for name, source in (("ball.yaml", "arm.yaml"), ("touches.yaml", "touches.yaml")):
        shutil.copy(TOUCHED / source, folder / name)
    touched = (TOUCHED / "panda_1.csv").read_text().splitlines()
    (folder / "touched.csv").write_text("\n".join([touched[0], *touched[1::4]]) + "\n")
    assert made("plan", arm, "--kind", "sobol", "-n", "3", "-o", folder / "next_poses.csv") == 0
    book = Workbook()
    for line in (("q1", "q2", "x", "y", "z"), (1, 2.5, 3, 4, 5), (2, 2.5, 3, 4, 5)):
        book.active.append(line)
    book.save(folder / "log.xlsx")
    (folder / "lift.urdf").write_text(LIFT)
    bending = Arm.load(arm)
    write_bag(read_csv(folder / "few.csv", bending), folder / "bag", bending)
    with robot(folder / "day") as put:
        for t, target in zip((10.0, 20.0), aims, strict=True):
            asked(put, t, ARM.mid, target)
            command(put, t + 0.1, ARM.mid.tolist())
            for k in (3.0, 4.0):
                state(put, t + k, ARM.mid.tolist())
                for topic in ("tip_measured", "tip_seen"):
                    sighting(put, t + k, target.tolist(), topic=topic)
    return folder


class HangError(BaseException):
    """Not an `Exception`, so that no reader of files takes it for a fault of the file."""


@contextmanager
def no_hang(what: str) -> Iterator[None]:
    """Turn an endless run into a failure. Far above what any of them takes."""

    def stop(_: int, __: object) -> None:
        raise HangError(what)

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def nonsense(folder: Path) -> str:
    """What is wrong with the files of a command that said it succeeded; empty if nothing is."""
    commands = folder / "commands.csv"
    if commands.exists():
        with commands.open(newline="") as file:
            for row in csv.DictReader(file):
                held = [row[f"q{j}"] for j in range(1, 9) if f"q{j}" in row]
                if row["status"] == "success" and not all(math.isfinite(float(v)) for v in held):
                    return f"a command of {held}"
    if (folder / "fitted.yaml").exists():
        try:
            model = load_model(folder / "fitted.yaml", Arm.load(folder / ARM_FILE))
        except LongarmError as error:
            return f"its own model is refused: {error}"
        if not np.isfinite(model.values).all():
            return "a model that is not finite"
    return ""


@pytest.mark.parametrize("part", range(PARTS))
def test_damaged_files(
    part: int,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    faults = []
    for run in range(RUNS // PARTS):
        seed = part * 1_000_000 + run
        rng = np.random.default_rng(seed)
        reading = READINGS[(run * PARTS + part) % len(READINGS)]
        name = reading.reads[int(rng.integers(len(reading.reads)))]
        folder = tmp_path / f"{run}"
        shutil.copytree(whole, folder)
        (folder / name).write_bytes(damaged((folder / name).read_bytes(), rng))
        monkeypatch.chdir(folder)
        shell = Shell(folder, capsys)
        what = f"seed {seed}: longarm {' '.join(reading.words)} with {name} damaged"
        try:
            with no_hang(what):
                code = shell(*reading.words)
        except (Exception, HangError) as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            faults.append(f"{what}: {error!r} in {last.filename}:{last.lineno}")
            continue
        said = [line for line in shell.err.splitlines() if line.startswith("longarm: ")]
        if code not in (0, 2, 3):
            faults.append(f"{what}: left with {code}")
        elif code and not said:
            faults.append(f"{what}: said nothing: {shell.err}")
        elif not code and nonsense(folder):
            faults.append(f"{what}: {nonsense(folder)}")
        shutil.rmtree(folder)
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    ("source", "read"),
    [
        ("servo_driver.yaml", ServoConfig.load),
        ("servo_driver.yaml", read_arm),
        ("arm_demo.yaml", Arm.load),
        ("report.json", lambda path: read_report(path.parent)),
    ],
    ids=["servos", "emulated servos", "arm", "report"],
)
def test_damaged_files_of_the_graph_and_of_reports(
    source: str, read: Callable[[Path], object], demo_arm_path: Path, tmp_path: Path
) -> None:
    """What the nodes and `apply` read, given to its loader: read, or refused as bad input."""
    if source == "report.json":
        report, _ = report_samples.named(np.random.default_rng(0))
        whole = record.text(record.parse_report(report)).encode()
    else:
        whole = (demo_arm_path.parent / source).read_bytes()
    path = tmp_path / source
    path.write_bytes(whole)
    read(path)
    where = []
    for seed in range(RUNS):
        path.write_bytes(damaged(whole, np.random.default_rng([7, seed])))
        try:
            with no_hang(f"{source}, seed {seed}"):
                read(path)
        except InputError as error:
            where.append(error.where)
        except Exception as error:
            raise AssertionError(f"{source}, seed {seed}: {error!r}") from error
    assert where and all(source in told for told in where)


def test_the_undamaged_files_work(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "here"
    shutil.copytree(whole, folder)
    monkeypatch.chdir(folder)
    left = {reading.words: Shell(folder)(*reading.words) for reading in READINGS}
    assert not any(left.values()), {words: code for words, code in left.items() if code}
    assert not nonsense(folder)
    assert load_model(folder / MODEL, Arm.load(folder / ARM_FILE)).effects
