"""The whole way with the arm of mujoco_arm.py, from a plan to the true errors of its commands.

python examples/mujoco_walk.py build/mujoco

Every command is printed as a user types it. Where the tip truly comes to rest only MuJoCo knows
(rests.csv); the commands know what the tracker sees.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

import longarm_comp as la

HERE = Path(__file__).parent
LONGARM = (sys.executable, "-m", "longarm_comp")
ENDS_S = 10.0  # patience with a program that was told to end


def main(folder: Path, seed: int, poses: int, targets: int, speed: int) -> None:
    """Walk the way; prints every command, then the table."""
    folder.mkdir(parents=True)
    arm, plan, rests = (folder / name for name in ("arm.yaml", "poses.csv", "rests.csv"))
    bag, found, verified = (folder / name for name in ("session", "diagnosis", "verified"))
    shutil.copyfile(HERE / "mujoco_arm.yaml", arm)
    shutil.copyfile(HERE / "mujoco_kinematics.yaml", folder / "kinematics.yaml")
    quick = ("--sightings", 3, "--dwell", 0.05)
    real = (HERE / "mujoco_arm.py", "--seed", seed, "--speed", speed, "--log", rests)
    with running(sys.executable, *real):
        longarm("plan", arm, "--kind", "sobol", "-n", poses, "--floor", 0.1, "-o", plan)
        longarm("collect", arm, plan, "--floor", 0.1, *quick, "-o", bag)
        longarm("diagnose", arm, bag, "--no-network", "-o", found)
        with running(*LONGARM, "up", arm, "--no-driver", "--model", found / "model.yaml"):
            longarm("verify", arm, "-n", targets, *quick, "-o", verified)
    report = json.loads((found / "report.json").read_text())
    print(f"\n{report['verdict']}: {report['summary']}\n")
    told = json.loads((verified / "verify.json").read_text())
    aimed = np.array([row["target"] for row in told["errors"]])
    stood = np.loadtxt(rests, delimiter=",")[-2 * len(aimed) :].reshape(2, len(aimed), -1)
    missed = 1e3 * np.linalg.norm(stood[..., -3:] - aimed, axis=2)
    used = la.load_model(found / "model.yaml", la.Arm.load(arm))
    sent = la.compensate(used, aimed, seed=stood[1, :, :-3])
    promised = np.array([1e3 * one.p90_m for one in sent])
    table = np.column_stack([aimed, *missed, promised])
    header = "x,y,z,without_mm,with_mm,p90_mm"
    np.savetxt(folder / "errors.csv", table, "%.5f", ",", header=header, comments="")
    for name, of in zip(("without compensation", "with compensation"), missed, strict=True):
        print(f"{name:<20}   true error: mean {of.mean():6.2f} mm   max {of.max():6.2f} mm")
    inside = int((missed[1] <= promised).sum())
    print(f"{inside} of {len(aimed)} inside their 90 % radius (mean {promised.mean():.2f} mm)")


@contextmanager
def running(*command: object) -> Iterator[None]:
    """A program beside; it ends with the block."""
    print("$", *command, "&", flush=True)
    program = subprocess.Popen([str(word) for word in command])
    try:
        yield
    finally:
        program.send_signal(signal.SIGINT)
        try:
            program.wait(ENDS_S)
        except subprocess.TimeoutExpired:
            program.kill()
            program.wait()


def longarm(*words: object) -> None:
    """Run a command as a user types it."""
    print("$ longarm", *words, flush=True)
    command = [*LONGARM, *map(str, words)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path, help="new folder for everything")
    parser.add_argument("--seed", type=int, default=1, help="which arm")
    parser.add_argument("--poses", type=int, default=120)
    parser.add_argument("--targets", type=int, default=40)
    parser.add_argument("--speed", type=int, default=40, help="of the arm's time")
    main(**vars(parser.parse_args()))
