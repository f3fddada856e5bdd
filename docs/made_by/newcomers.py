"""Two newcomers, as a script: every command that they type, what it says last, and its seconds.

::

    python docs/made_by/newcomers.py boom       # URDF and XLSX to commands in XLSX, nothing driven
    python docs/made_by/newcomers.py printed    # `init --hobby` to `verify`, on a simulated graph

The boom's truth is the simulated arm's: rods that are integrated, and effects that nobody declared.
Each walk ends with exit code 1 where its arm did not come as near as its page promises.
"""

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import sobol
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.geometry import DhError, JointZero
from longarm_comp.sim.hidden.loads import JointCompliance

PROGRAM = (sys.executable, "-m", "longarm_comp")

BOOM = """<robot name="boom">
  <link name="chassis"/>
  <link name="turret"/>
  <link name="outer"/>
  <link name="inner"/>
  <link name="jib"><inertial><origin xyz=".5 0 0"/><mass value="25"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="head"/>
  <joint name="slew" type="revolute"><parent link="chassis"/><child link="turret"/>
    <origin xyz="0 0 1.1"/><axis xyz="0 0 1"/>
    <limit lower="-2.0" upper="2.0" effort="1" velocity=".3"/></joint>
  <joint name="luff" type="revolute"><parent link="turret"/><child link="outer"/>
    <origin xyz=".15 0 .3"/><axis xyz="0 -1 0"/>
    <limit lower="-.1" upper="1.1" effort="1" velocity=".2"/></joint>
  <joint name="extend" type="prismatic"><parent link="outer"/><child link="inner"/>
    <origin xyz="4.6 0 0"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="2.8" effort="1" velocity=".3"/></joint>
  <joint name="knuckle" type="revolute"><parent link="inner"/><child link="jib"/>
    <origin xyz=".2 0 0"/><axis xyz="0 -1 0"/>
    <limit lower="-1.2" upper="1.2" effort="1" velocity=".5"/></joint>
  <joint name="nose" type="fixed"><parent link="jib"/><child link="head"/>
    <origin xyz="1.1 0 .03"/></joint>
</robot>
"""
BEAMS = """
  - {name: outer, row: 5, role: d, length_m: 4.4, E_pa: 2.1e11, poisson: 0.3, mass_kg: 160,
     body_length_m: 4.4, section: {type: rect, width_m: 0.18, height_m: 0.26, wall_m: 0.006}}
  - {name: inner, row: 5, role: d, length_m: rest, E_pa: 2.1e11, poisson: 0.3, mass_kg: 105,
     body_length_m: 3.6, section: {type: rect, width_m: 0.15, height_m: 0.22, wall_m: 0.005}}
"""
"""What the boom's owner adds to arm.yaml: two steel boxes, from the drawing (docs/arm.md)."""
NAMES = ("Slew [deg]", "Luff [deg]", "Extend [mm]", "Knuckle [deg]")
PER = np.array([180 / np.pi, 180 / np.pi, 1e3, 180 / np.pi])
TRACKER_M = 5e-5
ENOUGH_MM = 0.2


class Walk:
    """A folder in which the commands of a walk are run, one after the other."""

    def __init__(self, title: str) -> None:
        self._last, self._began = 0.0, time.monotonic()
        print(f"\n{title}\n{'wall s':>7} {'cpu s':>6}")

    def __call__(self, *words: object, ends: tuple[int, ...] = (0,)) -> str:
        """Run a command and print it; what it wrote to stdout."""
        began, cpu = time.monotonic(), _children()
        done = subprocess.run([*PROGRAM, *map(str, words)], capture_output=True, text=True)
        spent = time.monotonic() - began
        print(f"{spent:7.1f} {_children() - cpu:6.1f}  longarm {' '.join(map(str, words))}")
        for line in (done.stderr + done.stdout).strip().splitlines()[-3:]:
            print(f"{'':16}{line[:150]}")
        if done.returncode not in ends:
            sys.exit(f"exit code {done.returncode}\n{done.stdout}{done.stderr}")
        return done.stdout

    def ends(self, said: str, good: bool) -> int:
        """The last line; the exit code."""
        print(f"{time.monotonic() - self._began:7.1f}         {said}")
        return 0 if good else 1


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


# ------------------------------------------------------------------ a boom and a laser tracker


def boom(folder: Path) -> int:
    """From a URDF and a tracker's workbook to commands in the workbook's form."""
    os.chdir(folder)
    walk = Walk("A telescopic boom of 9 m and a laser tracker")
    Path("robot.urdf").write_text(BOOM)
    walk("init", "boom", "--urdf", "robot.urdf", "--base", "chassis", "--tip", "head", "--only-arm")
    declare(Path("boom/arm.yaml"))
    walk("check", "boom")
    truth = TrueBoom(Arm.load("boom/arm.yaml"))
    truth.measured(150, 7).to_excel("tracker.xlsx", index=False)
    truth.measured(25, 9).to_excel("second.xlsx", index=False)
    arm, samples, found = "boom/arm.yaml", "boom/samples.csv", "boom/diagnosis"
    walk("import-data", "tracker.xlsx", "--arm", arm, "-o", samples)
    walk("calibrate", arm, samples, "-o", "boom/model.yaml")
    walk("diagnose", arm, samples, "-o", found)
    like = ("--like", "boom/samples.mapping.yaml")
    walk("import-data", "second.xlsx", *like, "--arm", arm, "-o", "boom/test.csv")
    walk("evaluate", arm, "--test", "boom/test.csv", "--model", f"{found}/model.yaml")
    targets = truth.tracker(truth.real.tip(sobol(truth.arm, 30, 5).q))
    pd.DataFrame(1e3 * targets, columns=["X [mm]", "Y [mm]", "Z [mm]"]).to_excel(
        "targets.xlsx", index=False
    )
    model = ("--model", f"{found}/model.yaml", "--frame", "measured")
    walk("compensate", arm, "--targets", "targets.xlsx", *model, *like, "-o", "commands.xlsx")
    commands = pd.read_excel("commands.xlsx")
    good = commands[commands["status"] == "success"]
    reached = truth.tracker(truth.real.tip(good[list(NAMES)].to_numpy(float) / PER))
    misses = 1e3 * np.linalg.norm(reached - targets[good.index], axis=1)
    drawn = truth.tracker(truth.drawn.tip(good[list(NAMES)].to_numpy(float) / PER))
    bare = 1e3 * np.linalg.norm(drawn - reached, axis=1)
    report = json.loads(Path(f"{found}/report.json").read_text())
    names = [" or ".join(f["set"]) for f in report["findings"]]
    false = [f["effect"] for f in report["findings"] if not {*f["set"]} & {*truth.names}]
    said = (
        f"true tip - target: mean {misses.mean():.3f} mm, largest {misses.max():.3f} mm, of "
        f"{len(good)} of {len(commands)} commands (as drawn {bare.mean():.1f} mm); expected "
        f"{good['expected_mm'].mean():.3f} mm; named: {', '.join(names) or 'nothing'}"
        + (f"; FALSE: {', '.join(false)}" if false else "")
    )
    near = len(good) == len(commands) and misses.mean() <= ENOUGH_MM and not false
    return walk.ends(said, bool(near))


def declare(file: Path) -> None:
    """Add the beams, as the owner does with an editor."""
    file.write_text(file.read_text() + "links:" + BEAMS)


class TrueBoom:
    """The boom as it stands, and the tracker somewhere beside it."""

    names = ("joint_compliance", "joint_zero", "dh_error")
    """What was put wrong; zeros and lengths are fitted and need no name."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        zero = JointZero(np.array([4e-3, -6e-3, 3e-3, 5e-3]))
        soft = JointCompliance(np.array([0.0, 6e-7, 0.0, 2e-6]))
        lengths = DhError(np.random.default_rng(4).normal(0, 2e-3, (4, len(arm.joints))))
        self.real, self.drawn = TrueArm(arm, (zero, soft, lengths)), TrueArm(arm)
        self._turn = Rotation.from_euler("zyx", [37.0, 1.2, -0.6], degrees=True)
        self._at = np.array([12.1, -8.4, 1.8])

    def tracker(self, tip: np.ndarray) -> np.ndarray:
        """Points (N, 3) m of the base in the tracker's frame."""
        return self._turn.apply(tip) + self._at

    def measured(self, count: int, seed: int) -> pd.DataFrame:
        """What the tracker's program has written: deg and mm."""
        q, rng = sobol(self.arm, count, seed).q, np.random.default_rng(seed)
        seen = self.tracker(self.real.tip(q)) + rng.normal(0.0, TRACKER_M, (count, 3))
        rows = pd.DataFrame((q * PER).round(4), columns=NAMES)
        rows.insert(0, "No.", np.arange(1, count + 1))
        rows[["X [mm]", "Y [mm]", "Z [mm]"]] = (1e3 * seen).round(3)
        return rows


# ------------------------------------------------------------------ a printed arm and two webcams

PRINTED = (
    "d=0.09 limits=-60..60 servo_kg=0.06",
    "alpha=90 theta=60 limits=-30..30 servo_kg=0.06",
    "a=0.16 theta=-70 limits=-40..40 tube_a=20/17 material=petg servo_kg=0.06",
    "a=0.14 theta=-40 limits=-40..40 tube_a=16/13 material=petg servo_kg=0.03",
)
HIDDEN = ("joint_compliance=8.0", "backlash=3.0")
"""What the simulation's servos and joints have and nobody declared, mm at the tip."""


def printed(folder: Path) -> int:
    """From a table of rows to `verify`, over a real graph of a simulated arm."""
    os.chdir(folder)
    walk = Walk("A printed arm and two webcams")
    rows = [word for row in PRINTED for word in ("--joint", row)]
    walk("init", "arm", *rows, "--tip-at", 0.06, 0, 0, "--hobby")
    walk("check", "arm", ends=(0,))
    model, predictor = "arm/model.yaml", "arm/predictor.npz"
    with graph("arm/arm.yaml", "--model", model, "--predictor", predictor):
        plan = ("--kind", "sobol", "-n", 60, "--seen", "--floor", 0.02)
        walk("plan", "arm/arm.yaml", *plan, "-o", "arm/poses.csv")
        poses = ("arm/arm.yaml", "arm/poses.csv", "--floor", 0.02)
        walk("collect", *poses, "--dry-run")
        walk("collect", *poses, "--repeats", 8, "-o", "arm/session")
        walk("diagnose", "arm/arm.yaml", "arm/session", "-o", "arm/diagnosis")
        walk("apply", "arm/diagnosis")
        walk("verify", "arm/arm.yaml", "-n", 12, "-o", "arm/verified")
        walk("status")
    before, after = json.loads(Path("arm/verified/verify.json").read_text())["rows"]
    said = f"{before['mean_mm']:.2f} mm without compensation, {after['mean_mm']:.2f} mm with"
    return walk.ends(f"tip - target: {said}, of {after['n']} targets", after["mean_mm"] < 0.3)


@contextmanager
def graph(arm: str, *words: str) -> Iterator[None]:
    """The arm's graph, simulated, until the end."""
    hidden = [word for effect in HIDDEN for word in ("--hidden", effect)]
    call = ["up", arm, "--sim", "--speed", "10", *hidden, *words]
    print(f"{'':16}longarm {' '.join(call)} &")
    with (
        Path("up.log").open("w") as log,
        subprocess.Popen([*PROGRAM, *call], stderr=log) as process,
    ):
        try:
            yield
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=60)


def main() -> int:
    """The walk that is asked for, in a folder of its own."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("walk", choices=("boom", "printed"))
    asked.add_argument("--keep", type=Path, help="folder to leave the files in")
    given = asked.parse_args()
    walk = {"boom": boom, "printed": printed}[given.walk]
    if given.keep:
        given.keep.mkdir(parents=True)
        return walk(given.keep)
    with tempfile.TemporaryDirectory() as folder:
        return walk(Path(folder))


if __name__ == "__main__":
    sys.exit(main())
